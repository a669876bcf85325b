"""From one sub-map to the next without seeing anything: by DVL and attitude.

The body moves by the integral of R_nb v dt between the last pose of the one and the first pose of
the other, with v from the DVL and R_nb from the attitude filter, whose constant heading error the
first sub-map has shown. Depth needs no reckoning: the pressure sensor states it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from aquaflow.geometry.similarity import rotation_from_quaternion
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.estimator import Estimate
from aquaflow.telemetry.interpolation import columns_at
from aquaflow.telemetry.problem import Carried
from aquaflow.telemetry.state import HEADING
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.types import Attitude, Velocity

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
