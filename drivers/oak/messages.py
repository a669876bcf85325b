"""depthai's messages as AquaFlow's; duck-typed, so that the library loads only with a device."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass
class DaiPicture:
    """See :class:`aquaflow.drivers.oak.backend.OakPicture`."""

    message: Any
    exposed_ns: int
    device_ns: int
    sequence: int
    exposure_s: float | None
    iso: float | None

    def decode(self) -> npt.NDArray[np.uint8]:
        import cv2

        try:
            picture = self.message.getCvFrame()
        except RuntimeError as error:
            raise ValueError(str(error)) from error
        code = cv2.COLOR_GRAY2RGB if picture.ndim == 2 else cv2.COLOR_BGR2RGB
        return np.asarray(cv2.cvtColor(picture, code), np.uint8)


@dataclass
class DaiImuReading:
    """See :class:`aquaflow.drivers.oak.backend.ImuReading`."""

    t_ns: int
    acceleration_m_s2: tuple[float, float, float]
    rate_rad_s: tuple[float, float, float]


def picture_of(message: Any) -> DaiPicture:
    """A ``dai.ImgFrame``; an exposure of 0 means that the device reported none."""
    exposure_s = message.getExposureTime().total_seconds()
    return DaiPicture(
        message,
        nanoseconds(message.getTimestamp()),
        nanoseconds(message.getTimestampDevice()),
        int(message.getSequenceNum()),
        exposure_s or None,
        float(message.getSensitivity()) or None,
    )


def imu_readings(message: Any) -> list[DaiImuReading]:
    """The packets of a ``dai.IMUData``."""
    return [
        DaiImuReading(
            nanoseconds(packet.acceleroMeter.getTimestamp()),
            (packet.acceleroMeter.x, packet.acceleroMeter.y, packet.acceleroMeter.z),
            (packet.gyroscope.x, packet.gyroscope.y, packet.gyroscope.z),
        )
        for packet in message.packets
    ]


def nanoseconds(time: timedelta) -> int:
    """Exact, where total_seconds() of a computer that has been up for months is not."""
    return ((time.days * 86_400 + time.seconds) * 1_000_000 + time.microseconds) * 1_000
