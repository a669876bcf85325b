"""The Doppler velocity log (DVL)."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.telemetry.constants import Constants
from aquaflow.lab.synthetic.telemetry.series import choose, stretches
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise

__all__ = ["velocity"]

Array: TypeAlias = npt.NDArray[np.float64]


def velocity(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 4] m/s over ground in the body's axes, and the figure of merit; nan where it is silent.

    A driver turned the samples into the body by the stated mounting, and moved them to its
    origin; the mounting's error is what remains.
    """
    sigma = noise.dvl_sigma_m_s
    true_d = (1.0 + constants.dvl_scale) * motion.velocity_b(t) @ motion.mountings.R_bd
    measured = true_d + sigma * rng.standard_normal((len(t), 3))
    merit = sigma * np.exp(noise.dvl_merit_spread * rng.standard_normal((len(t), 1)))
    silent = choose(len(t), noise.dvl_dropout_share, rng)
    silent |= stretches(t, noise.dvl_lock_losses_per_min, noise.dvl_lock_loss_s, rng)
    return np.where(silent[:, None], np.nan, np.hstack([measured, merit]))
