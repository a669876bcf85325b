"""The calibration that an OAK carries in its EEPROM, as a CameraModel."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import DistortionModel
from aquaflow.types import CameraModel

HALF_PIXEL = 0.5
"""OpenCV puts the centre of the first pixel at 0, AquaFlow at 0.5."""


def camera_model(handler: Any, socket: Any, size: tuple[int, int]) -> CameraModel | None:
    """From a ``dai.CalibrationHandler``, for pictures of exactly ``size`` (width, height).

    It was made in air: behind a flat port in water it is wrong, and ``calibration`` in the config
    replaces it. None if the device was never calibrated.
    """
    try:
        K = handler.getCameraIntrinsics(socket, *size)
        coefficients = handler.getDistortionCoefficients(socket)
        fisheye = handler.getDistortionModel(socket).name == "Fisheye"
    except RuntimeError:
        return None
    if not np.all(np.isfinite(K)) or K[0][0] <= 0.0 or K[1][1] <= 0.0:
        return None
    model: DistortionModel = "fisheye" if fisheye else "radtan"
    return CameraModel(
        *size,
        K[0][0],
        K[1][1],
        K[0][2] + HALF_PIXEL,
        K[1][2] + HALF_PIXEL,
        distortion_model=model,
        distortion=tuple(coefficients[:4] if fisheye else coefficients),
    )


def imu_rotation(handler: Any, socket: Any) -> npt.NDArray[np.float64] | None:
    """[3, 3] rotation of IMU axes into camera axes; None if the device does not know."""
    try:
        transform = np.array(handler.getImuToCameraExtrinsics(socket), dtype=np.float64)
    except RuntimeError:
        return None
    rotation = transform[:3, :3]
    known = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    return rotation if known else None
