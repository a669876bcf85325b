"""The functions of an OAK camera that :class:`aquaflow.drivers.oak.camera.OakCamera` needs.

``DaiBackend`` speaks to the device; the replay backend in sim_drivers needs none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.config.cameras import OakConfig
from aquaflow.types import CameraModel


class OakPicture(Protocol):
    """A picture as the device delivered it."""

    exposed_ns: int
    """Middle of the exposure, CLOCK_MONOTONIC, as the library's time synchronisation has it."""
    device_ns: int
    """The same moment on the device's clock."""
    sequence: int
    exposure_s: float | None
    iso: float | None

    def decode(self) -> npt.NDArray[np.uint8]:
        """[H, W, 3] RGB; raises ValueError if the data makes no picture."""
        ...

    def jpeg(self) -> bytes | None:
        """The file that the device made; None where it sends pixels."""
        ...


class ImuReading(Protocol):
    """Accelerometer and gyroscope, each with its moment, in the axes of the IMU."""

    acceleration_ns: int
    acceleration_m_s2: tuple[float, float, float]
    rate_ns: int
    rate_rad_s: tuple[float, float, float]


class OakBackend(Protocol):
    """One opening of one camera; every call raises OSError when the device is gone."""

    def calibration(self) -> CameraModel | None:
        """Of the pictures' size; None if the device carries none."""
        ...

    def imu_to_camera(self) -> npt.NDArray[np.float64] | None:
        """[3, 3] rotation of the IMU's axes into the camera's (right, down, forward)."""
        ...

    def read(self, timeout_s: float) -> OakPicture | None:
        """The next picture; None when ``timeout_s`` passed without one."""
        ...

    def imu(self) -> Sequence[ImuReading]:
        """Readings since the last call."""
        ...

    def close(self) -> None: ...


OpenBackend: TypeAlias = Callable[[OakConfig], OakBackend]
"""Finds and starts the camera; raises OSError with a sentence while it is not there."""
