"""Messages from AquaFlow to a vehicle: sentences, values, pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LONGEST_TEXT, LONGEST_NAME = 50, 10
"""Characters that a message of MAVLink has room for."""


@dataclass(frozen=True)
class StatusText:
    """Text for the pilot. Ground stations speak it: up to ``LONGEST_TEXT`` characters are one
    message, a longer text comes in chunks, which older ones speak one by one."""

    severity: Literal["error", "warning", "notice", "info"]
    text: str


@dataclass(frozen=True)
class NamedValue:
    """A named number that a ground station can plot."""

    t_ns: int
    name: str
    value: float


@dataclass(frozen=True)
class BodyPose:
    """Pose and motion of the body (forward, right, down) in a level local frame, metres.

    The local frame's z points down; its x points north, or along the initial heading.
    """

    t_ns: int
    """CLOCK_MONOTONIC, moment of exposure."""
    R: Array
    """[3, 3] body to local."""
    t_m: Array
    """[3] of the body in the local frame."""
    covariance: Array
    """[6, 6] of x, y, z in the local frame and of roll, pitch, yaw, m and rad."""
    velocity_m_s: Array
    """[3] along the body's axes."""
    rate_rad_s: Array
    """[3] about the body's axes."""
    motion_covariance: Array
    """[6, 6] of velocity and rate, m/s and rad/s."""
    quality: float
    """0 to 1."""
    reset_counter: int
    """Changes, modulo 256, whenever the pose jumped."""
    north: bool
    """True if x points north (true or magnetic)."""


@dataclass(frozen=True)
class BodyPoseChange:
    """Change of the body's pose since the one before, in the axes of the body as it is now."""

    t_ns: int
    """CLOCK_MONOTONIC, moment of exposure."""
    since_ns: int
    """Time between the two poses."""
    rotation: Array
    """[3] rotation vector from the earlier body to this one, rad; the same in both bodies' axes."""
    translation_m: Array
    """[3]"""
    quality: float
    """0 to 1."""


OutboundMessage: TypeAlias = StatusText | NamedValue | BodyPose | BodyPoseChange


@runtime_checkable
class AcceptsMessages(Protocol):
    """A telemetry source whose devices accept messages."""

    def send(self, message: OutboundMessage) -> bool:
        """Queue a message for every device that understands it; False if none does. Never waits."""
        ...


# --------------------------------------------------------------------------------------------------
# What a vehicle's pilot does, as far as its devices tell: arming, and commands to AquaFlow.

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
