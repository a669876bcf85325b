"""What an autopilot's inertial sensors measure, and the attitude that it makes of them."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.telemetry.constants import Constants
from aquaflow.lab.synthetic.telemetry.series import random_walk, wander
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise

__all__ = ["acceleration", "angular_rate", "attitude"]

Array: TypeAlias = npt.NDArray[np.float64]


def attitude(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 4] quaternion wxyz of the body in NED.

    The true attitude is turned about the vertical by the compass error, and about the body's own
    axes by the wandering tilt (forward and right only) and white noise.
    """
    in_body = noise.attitude_sigma_deg * rng.standard_normal((len(t), 3))
    in_body[:, :2] += wander(t, noise.tilt_wander_sigma_deg, noise.tilt_wander_s, 2, rng)
    heading = np.zeros((len(t), 3))
    heading[:, 2:] = wander(t, noise.heading_wander_sigma_deg, noise.heading_wander_s, 1, rng)
    heading[:, 2] += constants.heading_offset_deg
    measured = (
        Rotation.from_rotvec(heading, degrees=True)
        * Rotation.from_matrix(motion.R_wb(t))
        * Rotation.from_rotvec(in_body, degrees=True)
    )
    return np.asarray(np.roll(measured.as_quat(canonical=True), 1, axis=1))


def angular_rate(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 3] rad/s, body frame."""
    white = noise.rate_sigma_rad_s * rng.standard_normal((len(t), 3))
    bias = constants.rate_bias_rad_s + random_walk(t, noise.rate_bias_walk, 3, rng)
    return np.asarray(motion.rate_b(t) + bias + white)


def acceleration(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 3] specific force, m/s^2, body frame."""
    white = noise.acceleration_sigma_m_s2 * rng.standard_normal((len(t), 3))
    return np.asarray(motion.force_b(t) + constants.acceleration_bias_m_s2 + white)
