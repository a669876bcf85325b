"""An OAK camera made of a recording: a backend that replaces the device."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import guess_camera
from aquaflow.sim_drivers.camera_feed import CameraFeed, Shot
from aquaflow.types import CameraModel

DEVICE_EPOCH_NS = 1_000_000_000_000
"""The device's clock started at another moment than the host's."""

ISO = 400.0
EXPOSURE_S = 0.008
"""Gain and exposure that simulated pictures state unless a test asks for others."""

IMU_TO_CAMERA = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""The simulated IMU has x forward, y right, z down."""

GYRO_EARLIER_NS = 400_000
"""A reading's gyroscope is so much older than its accelerometer: both run freely."""

GRAVITY_M_S2 = 9.80665
"""Standard gravity; an IMU at rest feels it upwards."""


@dataclass
class ReplayPicture:
    """See aquaflow.drivers.oak.camera.OakPicture."""

    shot: Shot
    exposed_ns: int
    device_ns: int
    sequence: int
    encoding: str
    exposure_s: float | None = EXPOSURE_S
    iso: float | None = ISO

    def decode(self) -> npt.NDArray[np.uint8]:
        if self.shot.corrupt:
            raise ValueError("the data is shorter than the picture")
        return self.shot.image

    def jpeg(self) -> bytes | None:
        import cv2

        if self.encoding != "mjpeg":
            return None
        return bytes(cv2.imencode(".jpg", cv2.cvtColor(self.shot.image, cv2.COLOR_RGB2BGR))[1])


@dataclass
class ReplayImuReading:
    """See aquaflow.drivers.oak.camera.ImuReading."""

    acceleration_ns: int
    acceleration_m_s2: tuple[float, float, float]
    rate_ns: int
    rate_rad_s: tuple[float, float, float]


class ReplayOak:
    """The device itself; every opening of it is a :class:`ReplayBackend` on the same feed."""

    def __init__(
        self,
        feed: CameraFeed,
        calibration: CameraModel | None = None,
        imu_to_camera: npt.NDArray[np.float64] | None = IMU_TO_CAMERA,  # [3, 3]
    ) -> None:
        self.feed = feed
        self.calibration = calibration
        self.imu_to_camera = imu_to_camera
        self.openings = 0

    def open(self, config: Any) -> ReplayBackend:
        """As the library finds and starts a device.

        Raises:
            FileNotFoundError: it is unplugged.
        """
        if not self.feed.plugged_in:
            raise FileNotFoundError("no OAK camera is plugged in; OAK cameras found: none")
        self.openings += 1
        return ReplayBackend(self, config)


class ReplayBackend:
    """See aquaflow.drivers.oak.camera.OakBackend. The vehicle stands level and still."""

    def __init__(self, device: ReplayOak, config: Any) -> None:
        rate_hz = config.imu_rate_hz
        self._device, self._encoding = device, config.encoding
        self._imu_period_ns = 0 if rate_hz == 0 else round(1e9 / rate_hz)
        self._imu_ns = time.monotonic_ns()
        self._gone = False

    def calibration(self) -> CameraModel | None:
        height, width = self._device.feed.peek().image.shape[:2]
        return self._device.calibration or guess_camera(width, height)

    def imu_to_camera(self) -> npt.NDArray[np.float64] | None:
        return self._device.imu_to_camera

    def read(self, timeout_s: float) -> ReplayPicture | None:
        self._check()
        if not self._device.feed.wait(timeout_s):
            return None
        shot = self._device.feed.take()
        self._gone = shot.unplugged
        self._check()
        device_ns = shot.true_ns - DEVICE_EPOCH_NS
        return ReplayPicture(shot, shot.exposed_ns, device_ns, shot.sequence, self._encoding)

    def imu(self) -> list[ReplayImuReading]:
        self._check()
        readings = []
        while self._imu_period_ns and self._imu_ns <= time.monotonic_ns():
            rate_ns = self._imu_ns - GYRO_EARLIER_NS
            readings.append(
                ReplayImuReading(self._imu_ns, (0.0, 0.0, -GRAVITY_M_S2), rate_ns, (0.0, 0.0, 0.0))
            )
            self._imu_ns += self._imu_period_ns
        return readings

    def close(self) -> None:
        self._gone = True

    def _check(self) -> None:
        if self._gone:
            raise ConnectionError("the OAK is gone: X_LINK_ERROR")
