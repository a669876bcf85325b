"""What a vehicle's pilot does, as far as its devices tell: arming, and commands to AquaFlow."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol, TypeAlias, runtime_checkable

PilotRequest: TypeAlias = Literal["start", "stop", "finish", "new"]
"""As the requests of docs/live.md#control."""
Obey: TypeAlias = Callable[[PilotRequest], bool]
"""Called in a device's thread, must not wait; False where the request makes no sense now."""


@runtime_checkable
class HearsPilot(Protocol):
    """A telemetry source with an autopilot among its devices."""

    @property
    def armed(self) -> bool | None:
        """Whether the motors may turn; None until an autopilot said so."""
        ...

    def obey(self, asked: Obey) -> None:
        """From now on pass commands to ``asked``; before, none is answered."""
        ...
