"""The echo sounder that looks down (altimeter)."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.telemetry.series import choose
from aquaflow.lab.synthetic.telemetry.sonar import Sonar
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise

__all__ = ["altitude"]

Array: TypeAlias = npt.NDArray[np.float64]


def altitude(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    sonar: Sonar,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 1] m to the first return within the beam; nan where there is none within its range."""
    path = motion.path
    origin_s = (motion.origin_w(t) - path.t_ws) @ path.R_ws
    R_sb = path.R_ws.T @ motion.R_wb(t)
    beam, longest = np.radians(noise.altitude_beam_deg), noise.altitude_longest_m
    true = sonar.first_return(origin_s, R_sb, beam, longest)
    white = noise.altitude_sigma_m * rng.standard_normal(len(t))
    multipath = choose(len(t), noise.altitude_multipath_share, rng)
    measured = np.where(multipath, 2.0, 1.0) * true + white
    if noise.altitude_resolution_m > 0.0:
        measured = noise.altitude_resolution_m * np.round(measured / noise.altitude_resolution_m)
    heard = (measured >= noise.altitude_shortest_m) & (measured <= longest)
    return np.where(heard, measured, np.nan)[:, None]
