"""How the body moved without seeing anything, by gyro, DVL and attitude.

The body moves by the integral of R_nb v dt between the last pose of the one and the first pose of
the other, with v from the DVL and R_nb from the attitude filter, whose constant heading error the
first sub-map has shown. Depth needs no reckoning: the pressure sensor states it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from aquaflow.geometry.similarity import on_so3, rotation_from_quaternion, so3_exp
from aquaflow.telemetry.camera_path import CameraPath, columns_at
from aquaflow.telemetry.estimator import Estimate
from aquaflow.telemetry.solve import Carried
from aquaflow.telemetry.state import HEADING
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.types import AngularRate, Attitude, TelemetrySample, Velocity

Array = npt.NDArray[np.float64]

LONGEST_S = 600.0
"""Beyond, nothing is carried over: a DVL and a compass drift by metres in ten minutes."""
LONGEST_SILENCE_S = 10.0
"""Without bottom lock; for so long the velocity before and after it is interpolated."""
HEADING_WANDER = np.radians(3.0)
"""rad, 1 sigma of what a compass's error changes between two sub-maps."""
VELOCITY_WANDER_M_S = 0.1
"""m/s, 1 sigma of an ROV's velocity against the interpolation across lost bottom lock."""


@dataclass(frozen=True)
class Reckoned:
    """A displacement of the body in n."""

    moved_m: Array
    """[3]"""
    covariance: Array
    """[2, 2] m^2, north and east."""


def carried_from(
    before: Estimate, path: CameraPath, telemetry: Telemetry, next_path: CameraPath
) -> Carried | None:
    """What the sub-map ``next_path`` starts with after the one of ``before`` with ``path``.

    None where the earlier one has no metric frame, or nothing measured the way between.
    """
    frame, solution = before.frame, before.solution
    if solution is None or not (frame.metric and frame.level) or len(next_path) == 0:
        return None
    first_s, last_s = float(path.t_s[-1]), float(next_path.t_s[0])
    reckoned = _reckon(telemetry, solution.state.heading, first_s, last_s)
    state = solution.state
    heading_sigma = float(
        np.hypot(np.sqrt(solution.covariance[HEADING, HEADING][0, 0]), HEADING_WANDER)
    )
    place = None
    if reckoned is not None:
        _, p_n = state.body(path.R_mc[-1:], path.p_m[-1:])
        covariance = frame.position_covariance(p_n[0])[:2, :2] + reckoned.covariance
        place = (last_s, (p_n[0] + reckoned.moved_m)[:2], covariance)
    return Carried(state, heading_sigma, place, frame.origin, frame.north == "true north")


def _reckon(telemetry: Telemetry, heading: float, first_s: float, last_s: float) -> Reckoned | None:
    """Displacement between two moments; None where DVL or attitude do not cover the time."""
    span = last_s - first_s
    velocities, attitudes = telemetry.of(Velocity), telemetry.of(Attitude)
    if not (0.0 < span <= LONGEST_S and velocities and attitudes):
        return None
    velocity, attitude = velocities[0], attitudes[0]
    t_s = np.union1d([first_s, last_s], velocity.between(first_s, last_s).t_s)
    gaps = np.diff(np.concatenate([[first_s], velocity.between(first_s, last_s).t_s, [last_s]]))
    reaches = attitude.t_s[0] <= first_s and attitude.t_s[-1] >= last_s
    if len(velocity) < 2 or gaps.max() > LONGEST_SILENCE_S or not reaches:
        return None
    R_nb = Slerp(attitude.t_s, Rotation.from_matrix(rotation_from_quaternion(attitude.values)))
    turn = Rotation.from_euler("z", -heading)
    v_b = columns_at(t_s, velocity.t_s, velocity.values[:, :3])
    v_n = (turn * R_nb(t_s)).apply(v_b)
    moved = np.trapezoid(v_n, t_s, axis=0)
    merit = float(np.median(velocity.values[:, 3]))
    silent = gaps[gaps > 1.0].sum()
    white = merit**2 * span * float(np.median(gaps)) + VELOCITY_WANDER_M_S**2 * silent * 1.0
    across = np.array([-moved[1], moved[0]])
    covariance = white * np.eye(2) + HEADING_WANDER**2 * np.outer(across, across)
    return Reckoned(moved, covariance + (0.003 * float(np.linalg.norm(moved))) ** 2 * np.eye(2))


# --------------------------------------------------------------------------------------------------
# How the body moved between two frames, by gyro and DVL: what tracking expects of the next one.

KEPT_S = 5.0
"""s of samples that are kept: frames are closer together, or nothing is expected of them."""
HELD_S = 0.15
"""s for which the newest value stands for what has not arrived yet: links are so late at most."""
HELD_VELOCITY_S = 0.6
"""The same of a DVL, which sends 4 to 15 values a second."""


class RecentMotion:
    """The last seconds of every gyro and DVL."""

    def __init__(self) -> None:
        self._rates: dict[str, deque[tuple[float, Array]]] = {}
        self._velocities: dict[str, deque[tuple[float, Array]]] = {}

    def add(self, sample: TelemetrySample) -> None:
        """Keep a rate or a velocity; other samples say nothing about motion."""
        if isinstance(sample, AngularRate):
            _keep(self._rates, sample.source, sample.t_ns, np.array(sample.rate_rad_s))
        elif isinstance(sample, Velocity):
            _keep(self._velocities, sample.source, sample.t_ns, np.array(sample.velocity_m_s))

    def turn(self, first_s: float, last_s: float) -> Array | None:
        """R_b0b1 [3, 3], from the body at the later moment to the body at the earlier one.

        None where no gyro covers the time.
        """
        for samples in self._rates.values():
            pieces = _between(samples, first_s, last_s, HELD_S)
            if pieces is not None:
                R = np.eye(3)
                for duration_s, rate in pieces:
                    R = R @ so3_exp(duration_s * rate)
                return on_so3(R)
        return None

    def displacement(self, first_s: float, last_s: float) -> Array | None:
        """[3] m, displacement of the body's origin in its axes on the way; None without a DVL.

        The turn within the time is left out: it is a few degrees between two frames.
        """
        for samples in self._velocities.values():
            pieces = _between(samples, first_s, last_s, HELD_VELOCITY_S)
            if pieces is not None:
                return np.asarray(sum(duration_s * velocity for duration_s, velocity in pieces))
        return None


def _keep(
    kept: dict[str, deque[tuple[float, Array]]],  # s and [3] of each source
    source: str,
    t_ns: int,
    value: Array,  # [3]
) -> None:
    samples = kept.setdefault(source, deque())
    t_s = t_ns * 1e-9
    if samples and t_s <= samples[-1][0]:
        return  # late, or the clock was set back
    samples.append((t_s, value))
    while samples[0][0] < t_s - KEPT_S:
        samples.popleft()


def _between(
    samples: deque[tuple[float, Array]],  # s and [3]
    first_s: float,
    last_s: float,
    held_s: float,
) -> list[tuple[float, Array]] | None:
    """Durations and values [3] that fill the time; None where a gap is longer than ``held_s``."""
    pieces: list[tuple[float, Array]] = []
    at = first_s
    value: Array | None = None
    for t_s, new in samples:
        if t_s > at and value is not None:
            until = min(t_s, last_s)
            if until - at > held_s:
                return None
            pieces.append((until - at, 0.5 * (value + new)))
            at = until
        if at >= last_s:
            return pieces
        if t_s <= at:
            value = new if at - t_s <= held_s else None
    if value is None or last_s - samples[-1][0] > held_s:
        return None
    return [*pieces, (last_s - at, samples[-1][1])]
