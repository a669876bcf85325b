"""depthai's messages as AquaFlow's; duck-typed, so that the library loads only with a device."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass
class DaiPicture:
    """See :class:`aquaflow.drivers.oak.camera.OakPicture`."""

    message: Any
    exposed_ns: int
    device_ns: int
    sequence: int
    exposure_s: float | None
    iso: float | None
    is_jpeg: bool = False

    def decode(self) -> npt.NDArray[np.uint8]:
        import cv2

        if self.is_jpeg:
            return self._unpack()
        try:
            picture = self.message.getCvFrame()
        except RuntimeError as error:
            raise ValueError(str(error)) from error
        code = cv2.COLOR_GRAY2RGB if picture.ndim == 2 else cv2.COLOR_BGR2RGB
        return np.asarray(cv2.cvtColor(picture, code), np.uint8)

    def jpeg(self) -> bytes | None:
        return bytes(self.message.getData()) if self.is_jpeg else None

    def _unpack(self) -> npt.NDArray[np.uint8]:
        import cv2

        data = np.asarray(self.message.getData(), np.uint8)
        try:
            picture = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
        except cv2.error as error:
            raise ValueError("it is a damaged JPEG") from error
        if picture is None:
            raise ValueError("it is a damaged JPEG")
        return np.asarray(picture, np.uint8)


@dataclass
class DaiImuReading:
    """See :class:`aquaflow.drivers.oak.camera.ImuReading`."""

    acceleration_ns: int
    acceleration_m_s2: tuple[float, float, float]
    rate_ns: int
    rate_rad_s: tuple[float, float, float]


def picture_of(message: Any, is_jpeg: bool = False) -> DaiPicture:
    """A ``dai.ImgFrame``, or a ``dai.EncodedFrame``; an exposure of 0 means that none is reported.

    Its times are those of the end of the exposure, of the first row where the shutter rolls
    (luxonis/depthai#795; CameraExposureOffset.MIDDLE, which encoded frames lack, takes half the
    exposure off it). What is seen was seen in the middle.
    """
    exposure = message.getExposureTime()
    half_ns = nanoseconds(exposure) // 2
    return DaiPicture(
        message,
        nanoseconds(message.getTimestamp()) - half_ns,
        nanoseconds(message.getTimestampDevice()) - half_ns,
        int(message.getSequenceNum()),
        exposure.total_seconds() or None,
        float(message.getSensitivity()) or None,
        is_jpeg,
    )


def imu_readings(message: Any) -> list[DaiImuReading]:
    """The packets of a ``dai.IMUData``."""
    return [
        DaiImuReading(
            nanoseconds(packet.acceleroMeter.getTimestamp()),
            (packet.acceleroMeter.x, packet.acceleroMeter.y, packet.acceleroMeter.z),
            nanoseconds(packet.gyroscope.getTimestamp()),
            (packet.gyroscope.x, packet.gyroscope.y, packet.gyroscope.z),
        )
        for packet in message.packets
    ]


def nanoseconds(time: timedelta) -> int:
    """Exact, where total_seconds() of a computer that has been up for months is not."""
    return ((time.days * 86_400 + time.seconds) * 1_000_000 + time.microseconds) * 1_000
