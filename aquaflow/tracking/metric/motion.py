"""The next frame's motion, as gyro and DVL have it, in the units of tracking."""

from __future__ import annotations

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.recent_motion import RecentMotion

LONGEST_S = 2.0
"""Between two frames of which the second is expected; a survey camera takes one a second."""


def motion_of_camera(
    recent: RecentMotion,
    T_bc: Sim3,
    metres_per_unit: float | None,
    first_ns: int,
    last_ns: int,
    before: Sim3,
) -> Sim3 | None:
    """T_c1c0 from the camera at the earlier moment to the camera at the later one.

    The turn is the gyro's; the translation is the DVL's where the scale is known, else that of
    ``before``, the motion between the two frames before. None where no gyro covers the time.

    Args:
        T_bc: camera to body, m.
        metres_per_unit: of the keyframe that poses are relative to; None while unknown.
    """
    first_s, last_s = first_ns * 1e-9, last_ns * 1e-9
    if not 0.0 < last_s - first_s <= LONGEST_S:
        return None
    R_b0b1 = recent.turn(first_s, last_s)
    if R_b0b1 is None:
        return None
    R_c0c1 = T_bc.R.T @ R_b0b1 @ T_bc.R
    moved = None if metres_per_unit is None else recent.moved(first_s, last_s)
    if moved is None or metres_per_unit is None:
        away = -(before.R.T @ before.t)  # of the camera, in its earlier axes
    else:
        arm = (R_b0b1 - np.eye(3)) @ T_bc.t
        away = T_bc.R.T @ (moved + arm) / metres_per_unit
    return Sim3(R_c0c1.T, -(R_c0c1.T @ away))
