"""What an autopilot's inertial sensors measure, and the attitude that it makes of them."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.synthetic.motion import BodyMotion
from aquaflow.synthetic.telemetry_noise import TelemetryNoise

__all__ = ["angular_rate", "attitude"]

Array: TypeAlias = npt.NDArray[np.float64]


def attitude(
    t: Array,  # [N] s
    motion: BodyMotion,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 4] quaternion wxyz of the body in NED."""
    white = np.radians(noise.attitude_sigma_deg) * rng.standard_normal((len(t), 3))
    measured = Rotation.from_matrix(motion.R_wb(t)) * Rotation.from_rotvec(white)
    return np.asarray(np.roll(measured.as_quat(canonical=True), 1, axis=1))


def angular_rate(
    t: Array,  # [N] s
    motion: BodyMotion,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 3] rad/s, body frame."""
    return motion.rate_b(t) + noise.rate_sigma_rad_s * rng.standard_normal((len(t), 3))
