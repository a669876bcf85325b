"""What those who look on may read of the service, in a dive and between dives."""

from __future__ import annotations

from typing import Protocol

from aquaflow.live.health.counters import Counters
from aquaflow.live.health.degradation import Degradation
from aquaflow.live.health.state import Health
from aquaflow.types import Frame


class ServiceStatus(Protocol):
    """The live loop, or the standby between dives."""

    @property
    def health(self) -> Health:
        """State and reason."""
        ...

    @property
    def counters(self) -> Counters:
        """Of the present dive; between dives of nothing."""
        ...

    @property
    def degradation(self) -> Degradation:
        """How much is left out."""
        ...

    @property
    def picture(self) -> Frame | None:
        """The newest frame."""
        ...
