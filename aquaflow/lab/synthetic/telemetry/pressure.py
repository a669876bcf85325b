"""The depth cell, and what moves the surface above it.

World z is 0 at the surface of the first picture, between the waves.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.motion import GRAVITY_M_S2, TrueBodyMotion
from aquaflow.lab.synthetic.telemetry.constants import Constants
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise

__all__ = ["depth", "tide", "wave"]

Array: TypeAlias = npt.NDArray[np.float64]


def depth(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 1] m below the surface, as the pressure has it."""
    true = motion.origin_w(t)[:, 2]
    measured = true + constants.depth_offset_m + tide(t, constants, noise)
    measured += wave(t, true, constants, noise)
    measured += noise.depth_sigma_m * rng.standard_normal(len(t))
    if noise.depth_resolution_m > 0.0:
        measured = noise.depth_resolution_m * np.round(measured / noise.depth_resolution_m)
    return np.asarray(measured)[:, None]


def tide(
    t: Array,  # [N] s
    constants: Constants,
    noise: TelemetryNoise,
) -> Array:
    """[N] m by which the water has risen since the first picture."""
    phase = 2.0 * math.pi * t / noise.tide_period_s + constants.tide_phase_rad
    return noise.tide_amplitude_m * (np.cos(phase) - math.cos(constants.tide_phase_rad))


def wave(
    t: Array,  # [N] s
    depth_m: Array,  # [N] m
    constants: Constants,
    noise: TelemetryNoise,
) -> Array:
    """[N] m of water that a regular wave adds to the pressure at a depth.

    Linear theory of deep water: the pressure falls off by exp(-k depth) with k = omega^2 / g.
    """
    omega = 2.0 * math.pi / noise.wave_period_s
    felt = np.exp(-(omega**2) / GRAVITY_M_S2 * np.maximum(depth_m, 0.0))
    phase = omega * t + constants.wave_phase_rad
    return np.asarray(0.5 * noise.wave_height_m * felt * np.cos(phase))
