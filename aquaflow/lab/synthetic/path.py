"""The vehicle's path: a way over the floor at an altitude, with sway.

For the survey frame and the world see :mod:`aquaflow.lab.synthetic.mounting`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.mounting import mountings_of, survey_to_world
from aquaflow.lab.synthetic.ways import DENSE, Way, way_of

Array: TypeAlias = npt.NDArray[np.float64]

MAX_TURN_RATE_DEG_S = 6.0
"""Sway slows down to this where a short dive would make it faster: flow stays below 6 % of W."""
MAX_CLIMB_M_S = 0.3
"""Fastest change of height with which the vehicle follows the floor."""


@dataclass(frozen=True)
class Path:
    """Pose of the camera and attitude of the body as smooth functions of time."""

    position: CubicSpline
    """t -> [3] m, survey frame."""
    heading: CubicSpline
    """t -> rad about the survey frame's z, before sway."""
    sway: tuple[tuple[float, float, float], ...]
    """(amplitude rad, angular frequency rad/s, phase) of roll, pitch and yaw."""
    R_ws: Array
    t_ws: Array
    R_bc: Array
    """[3, 3] camera axes in the body, in truth."""

    def centre_s(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """Camera centre [N, 3] in the survey frame at times t [N] s."""
        return np.asarray(self.position(t))

    def centre_w(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """Camera centre [N, 3] in the world."""
        return self.centre_s(t) @ self.R_ws.T + self.t_ws

    def velocity_w(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """Velocity over ground [N, 3] m/s in the world."""
        return np.asarray(self.position(t, 1)) @ self.R_ws.T

    def R_wb(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """Body in the world [N, 3, 3]."""
        angles = [a * np.sin(w * t + p) - a * math.sin(p) for a, w, p in self.sway]
        angles[2] = angles[2] + self.heading(t)
        survey = Rotation.from_euler("ZYX", np.stack(angles[::-1], axis=1)).as_matrix()
        return np.asarray(self.R_ws @ survey @ self.R_ws.T)

    def R_wc(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """Camera in the world [N, 3, 3]."""
        return np.asarray(self.R_wb(t) @ self.R_bc)

    def rate_b(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """Angular rate [N, 3] rad/s in the body frame."""
        return turn_rate(self.R_wb, t)


HALF_STEP_S = 1e-4
"""Of the central difference that gives angular rates."""


def turn_rate(
    R_wb: Callable[[Array], Array],
    t: Array,  # [N] s
) -> Array:
    """[N, 3] rad/s at which a body turns, in its frame; ``R_wb``: [N, 3, 3] where it is then."""
    before, after = R_wb(t - HALF_STEP_S), R_wb(t + HALF_STEP_S)
    turn = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec()
    return np.asarray(turn / (2.0 * HALF_STEP_S))


def plan_path(
    config: SyntheticConfig,
    rng: np.random.Generator,
    relief: Array | None = None,  # [DENSE + 1] m, height of the floor below the loop
) -> Path:
    """The path over a flat floor, or over ``relief`` where the floor is known."""
    way = way_of(config)
    period = config.duration_s
    at = np.linspace(0.0, period, DENSE + 1)
    omega = 2.0 * math.pi * (config.rises or way.rounds) / period
    swing = min(config.altitude_swing_m, MAX_CLIMB_M_S / omega)
    altitude = config.altitude_m + swing * np.cos(omega * at)
    ground = np.zeros(DENSE + 1) if relief is None else _height_to_follow(relief, config, way)
    points = np.column_stack([way.points, -(ground + altitude)])
    if way.closed:
        points[-1] = points[0]
    amplitudes = (config.roll_deg, config.pitch_deg, config.yaw_deg)
    sway = []
    for amplitude, period_s in zip(amplitudes, (3.7, 4.6, 9.0), strict=True):
        # Whole cycles in the loop, so that its end looks where its start looked.
        omega = 2.0 * math.pi * max(1, round(period / period_s)) / period
        limit = min(amplitude, MAX_TURN_RATE_DEG_S / omega)
        sway.append((math.radians(limit), omega, float(rng.uniform(-0.5, 0.5))))
    R_ws, t_ws = survey_to_world(config)
    R_bc = mountings_of(config).R_bc
    spline = CubicSpline(at, points, bc_type="periodic" if way.closed else "not-a-knot")
    return Path(spline, CubicSpline(at, way.heading), tuple(sway), R_ws, t_ws, R_bc)


def _height_to_follow(
    relief: Array,  # [DENSE + 1] m
    config: SyntheticConfig,
    way: Way,
) -> Array:
    """What the vehicle follows of the relief: smoothed over 0.6 m, the altimeter's footprint."""
    step = config.speed_m_s * config.duration_s / DENSE
    if not way.closed:
        return np.asarray(gaussian_filter1d(relief, 0.6 / step, mode="nearest"))
    smooth = gaussian_filter1d(relief[:-1], 0.6 / step, mode="wrap")
    return np.append(smooth, smooth[0])
