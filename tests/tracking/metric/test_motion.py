"""The camera's expected motion, from a body that moves as gyro and DVL say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import BODY_FROM_CAMERA, Sim3
from aquaflow.telemetry.dead_reckoning import RecentMotion
from aquaflow.tracking.metric.world_frames import LONGEST_S, motion_of_camera
from aquaflow.types import AngularRate, Velocity

T_BC = Sim3(
    Rotation.from_euler("y", -40, degrees=True).as_matrix() @ BODY_FROM_CAMERA,
    np.array([0.2, 0, 0.1]),
)
RATE, SPEED = np.array([0.05, -0.1, 0.3]), np.array([0.4, 0.1, -0.2])
SCALE = 1.7
SECOND = 1_000_000_000


def body_at(t_s: float) -> Sim3:
    """Body to world, of a body whose rate and velocity are constant in its own axes."""
    steps = 2000
    R, p = Rotation.identity(), np.zeros(3)
    for _ in range(steps):
        half = R * Rotation.from_rotvec(0.5 * t_s / steps * RATE)
        p = p + half.apply(SPEED) * t_s / steps
        R = R * Rotation.from_rotvec(t_s / steps * RATE)
    return Sim3(R.as_matrix(), p)


def recent(velocity: bool = True) -> RecentMotion:
    motion = RecentMotion()
    for k in range(60):
        t_ns = k * 20_000_000
        motion.add(AngularRate(t_ns, t_ns, "gyro", (RATE[0], RATE[1], RATE[2])))
        if velocity:
            motion.add(Velocity(t_ns, t_ns, "dvl", (SPEED[0], SPEED[1], SPEED[2]), 0.01))
    return motion


def true_motion(first_s: float, last_s: float) -> Sim3:
    """T_c1c0 with translations in units of 1 / SCALE metres."""
    T_c0, T_c1 = body_at(first_s) @ T_BC, body_at(last_s) @ T_BC
    T = T_c1.inverse() @ T_c0
    return Sim3(T.R, T.t / SCALE)


def test_gyro_and_dvl_give_the_cameras_motion_with_its_lever_arm() -> None:
    found = motion_of_camera(recent(), T_BC, SCALE, SECOND // 2, 6 * SECOND // 10, Sim3.identity())
    wanted = true_motion(0.5, 0.6)
    assert found is not None
    assert np.allclose(found.R, wanted.R, atol=1e-6)
    assert np.allclose(found.t, wanted.t, atol=1e-3)


@pytest.mark.parametrize(("velocity", "scale"), [(False, SCALE), (True, None)])
def test_without_dvl_or_scale_the_translation_goes_on(velocity: bool, scale: float | None) -> None:
    before = true_motion(0.4, 0.5)
    found = motion_of_camera(recent(velocity), T_BC, scale, SECOND // 2, 6 * SECOND // 10, before)
    assert found is not None
    assert np.allclose(found.R, true_motion(0.5, 0.6).R, atol=1e-6)
    assert np.allclose(found.R.T @ found.t, before.R.T @ before.t)


@pytest.mark.parametrize("last_s", [0.0, 0.5, 0.5 + LONGEST_S + 0.1])
def test_nothing_is_expected_of_frames_in_the_past_or_far_away(last_s: float) -> None:
    last_ns = round(last_s * SECOND)
    assert motion_of_camera(recent(), T_BC, 1.0, SECOND // 2, last_ns, Sim3.identity()) is None


def test_without_a_gyro_nothing_is_expected() -> None:
    assert motion_of_camera(RecentMotion(), T_BC, 1.0, 0, SECOND, Sim3.identity()) is None
