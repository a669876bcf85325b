"""Ways over the floor: lanes closed to a loop, an oval round a pool, a survey's straight line."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from aquaflow.lab.synthetic.config import SyntheticConfig

Array: TypeAlias = npt.NDArray[np.float64]

DENSE = 2048
"""Steps of a way from which splines are made."""
OVAL = 0.6
"""Short over long axis of the way round a pool."""
LAP_M = 15.0
"""About the length of a lap round a pool; a longer dive makes several."""
LAP_SWING = 0.15
"""By which laps are wider or narrower than their mean."""
WANDER_M = 0.08
"""Amplitude by which a survey leaves its line."""

TURN_S = 2.4
"""Standard deviation in time over which a turn is spread: half a turn from lane to lane then goes
at up to 30 degrees/s."""


@dataclass(frozen=True)
class Way:
    """Where the vehicle goes, seen from above, and where it points."""

    points: Array
    """[DENSE + 1, 2] m, survey frame, equal arc lengths."""
    heading: Array
    """[DENSE + 1] rad from the survey frame's x towards its y."""
    rounds: int
    """How often the altitude rises and falls along the way."""
    closed: bool
    """True if the last point is the first."""


def way_of(config: SyntheticConfig) -> Way:
    """The way of a dive's scene, as long as its speed and duration make it; that of a visit is
    turned and moved over the floor that it visits."""
    own = _own_way(config)
    if config.visit is None:
        return own
    turn = math.radians(config.visit.heading_deg)
    c, s = math.cos(turn), math.sin(turn)
    middle = _own_way(config.visit.over).points.mean(axis=0) + config.visit.offset_m
    points = (own.points - own.points.mean(axis=0)) @ np.array([[c, s], [-s, c]]) + middle
    return replace(own, points=points, heading=own.heading + turn)


def _own_way(config: SyntheticConfig) -> Way:
    """As it is over a floor of its own."""
    held = np.zeros(DENSE + 1)
    if config.scene == "pool":
        points = _oval(config)
        return Way(points, _ahead(points), 1, True)
    if config.scene == "survey":
        points = _line(config)
        return Way(points, _along(points) if config.turns else held, 1, False)
    points, lanes = _lane_loop(config)
    heading = _spread(_ahead(points), config) if config.turns else held
    return Way(points, heading, lanes // 2, True)


def _ahead(
    points: Array,  # [DENSE + 1, 2] m, closed
) -> Array:
    """[DENSE + 1] rad, the direction of a closed way."""
    tangent = np.gradient(np.vstack([points[-2], points, points[1]]), axis=0)[1:-1]
    return np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))


def _along(
    points: Array,  # [DENSE + 1, 2] m, open
) -> Array:
    """[DENSE + 1] rad, the direction of an open way."""
    tangent = np.gradient(points, axis=0)
    return np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))


def _spread(
    heading: Array,  # [DENSE + 1] rad of a closed way
    config: SyntheticConfig,
) -> Array:
    """[DENSE + 1] rad, with corners that take the vehicle some time."""
    trend = np.linspace(0.0, heading[-1] - heading[0], DENSE + 1)
    step_s = config.duration_s / DENSE
    smooth = gaussian_filter1d((heading - trend)[:-1], TURN_S / step_s, mode="wrap")
    return np.append(smooth, smooth[0]) + trend


def _oval(config: SyntheticConfig) -> Array:
    """Laps round a pool, wider and narrower ones by turns; one lap is a plain oval."""
    laps = max(1, round(config.speed_m_s * config.duration_s / LAP_M))
    angle = np.linspace(0.0, 2.0 * math.pi * laps, (DENSE + 1) * laps)
    wide = 1.0 + (LAP_SWING * np.sin(angle * (laps - 1) / laps) if laps > 1 else 0.0)
    oval = np.stack([np.sin(angle), -OVAL * np.cos(angle)], axis=1) * np.reshape(wide, (-1, 1))
    points = _equal_arcs(oval, DENSE)
    points[-1] = points[0]
    round_ = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return np.asarray(points * (config.speed_m_s * config.duration_s / round_))


def _line(config: SyntheticConfig) -> Array:
    length = config.speed_m_s * config.duration_s
    x = np.linspace(0.0, length, DENSE + 1)
    return np.stack([x, WANDER_M * np.sin(2.0 * math.pi * x / length)], axis=1)


def _lane_loop(config: SyntheticConfig) -> tuple[Array, int]:
    """The loop [DENSE + 1, 2] (m, survey frame, equal arc lengths) and its number of lanes."""
    length = config.speed_m_s * config.duration_s
    spacing = min(config.lane_spacing_m, length / 8.0)
    lanes = 2
    while _lane(length, lanes, spacing) > config.lane_length_m:
        lanes += 2
    run = _lane(length, lanes, spacing)
    corners = [(run * ((k + 1) // 2 % 2), (k // 2) * spacing) for k in range(2 * lanes)]
    points = np.array([*corners, (0.0, 0.0)])
    for _ in range(4):
        points = _equal_arcs(points, DENSE)
        step = length / DENSE
        smooth = gaussian_filter1d(points[:-1], 0.3 * spacing / step, axis=0, mode="wrap")
        points = np.vstack([smooth, smooth[:1]])
        points *= length / np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return points, lanes


def _lane(length: float, lanes: int, spacing: float) -> float:
    return (length - 2.0 * (lanes - 1) * spacing) / lanes


def _equal_arcs(
    points: Array,  # [N, 2] m
    count: int,
) -> Array:
    """The polyline ``points`` [N, 2] at count + 1 equal steps of arc length."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, arc[-1], count + 1)
    return np.stack([np.interp(at, arc, points[:, k]) for k in range(2)], axis=1)
