"""A dive's motion and telemetry without its pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.config.stage import MountingConfig
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.site import site_of
from aquaflow.lab.synthetic.telemetry.constants import Constants, draw_constants
from aquaflow.lab.synthetic.telemetry.measurement import measure
from aquaflow.lab.synthetic.telemetry.sonar import Sonar
from aquaflow.types import TelemetrySample

__all__ = ["SimulatedDive", "simulate"]

Array: TypeAlias = npt.NDArray[np.float64]

CELL_M = 0.05
"""Of the relief: a tenth of an altimeter's footprint at 1.1 m."""


@dataclass(frozen=True)
class SimulatedDive:
    """What is true of a dive, and what its instruments say."""

    config: SyntheticConfig
    times_s: Array
    """[N] of the pictures; the first is 0."""
    T_wc: Array
    """[N, 4, 4] camera to world (z down, m, z = 0 at the surface; x is north), in truth."""
    T_bc: Array
    """[4, 4] camera to body (forward, right, down), m, in truth."""
    T_bc_stated: Array
    """[4, 4] the same as a user believes it: turned from the truth by ``mounting_error_deg``."""
    mounting: MountingConfig
    """``T_bc_stated`` as a vehicle's configuration has it."""
    R_bd: Array
    """[3, 3] axes of the DVL's samples to the body, in truth; the identity is stated."""
    constants: Constants
    """Errors of the instruments that were drawn once."""
    motion: TrueBodyMotion
    """The body's true pose, velocity, rate and specific force at any time of the dive."""
    samples: list[TelemetrySample]
    """In order of arrival; times are ns since the first picture. They are those of the body's
    origin and axes, as drivers hand them over."""


def simulate(config: SyntheticConfig) -> SimulatedDive:
    """Swim a dive without rendering it.

    The relief has cells of 5 cm at least. Where the pictures need finer ones, as usual, the dive
    that ``write_dive`` makes from the same config has another floor of the same kind, and follows
    that: same lanes, speeds, sway, mountings and constant errors, other heights.
    """
    site = site_of(config, CELL_M)
    motion, mountings = site.motion, site.motion.mountings
    constants = draw_constants(config)
    times_s = np.arange(config.frames) / config.fps
    return SimulatedDive(
        config,
        times_s,
        motion.T_wc(times_s),
        mountings.T_bc,
        mountings.T_bc_stated,
        mountings.stated,
        mountings.R_bd,
        constants,
        motion,
        measure(config, motion, Sonar(site.relief.area, site.crests), constants),
    )
