"""Trajectory errors: exact on known cases, and invariant where they must be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.evaluation.trajectory_error import (
    Trajectory,
    horizontal_error,
    position_error,
    trajectory_error,
)


def walk(seed: int = 0, count: int = 15) -> Trajectory:
    rng = np.random.default_rng(seed)
    quaternions = Rotation.random(count, random_state=seed).as_quat(scalar_first=True)
    return Trajectory(np.arange(count) * 0.1, rng.normal(size=(count, 3)).cumsum(0), quaternions)


def noisy(truth: Trajectory, seed: int, sigma: float = 0.05) -> Trajectory:
    noise = np.random.default_rng(seed).normal(scale=sigma, size=truth.positions.shape)
    return Trajectory(truth.t_s, truth.positions + noise, truth.wxyz)


def similarity(seed: int, scale: float) -> Sim3:
    turn = Rotation.random(random_state=seed).as_matrix()
    return Sim3(turn, np.random.default_rng(seed).normal(size=3), scale)


@given(st.integers(0, 2**31), st.floats(0.05, 20.0))
def test_moved_and_scaled_truth_has_no_error_but_in_scale(seed, scale):
    truth = walk(seed)

    error = trajectory_error(truth.transform(similarity(seed, scale)), truth, truth.path_length)

    assert error.sim3.rmse < 1e-6
    assert error.relative.translation_rmse < 1e-6
    assert error.relative.rotation_rmse_deg < 1e-5
    assert error.rotation_rmse_deg < 1e-5
    assert error.drift_pct < 1e-5
    assert error.sim3.alignment.T_target_source.scale == pytest.approx(1.0 / scale)


@given(st.integers(0, 2**31), st.floats(0.05, 20.0))
def test_errors_do_not_depend_on_the_map_s_frame_or_scale(seed, scale):
    truth = walk(seed)
    estimate = noisy(truth, seed + 1)

    here = trajectory_error(estimate, truth, truth.path_length)
    moved = estimate.transform(similarity(seed, scale))
    there = trajectory_error(moved, truth, truth.path_length)

    assert there.sim3.rmse == pytest.approx(here.sim3.rmse, rel=1e-6)
    assert there.drift_pct == pytest.approx(here.drift_pct, rel=1e-6)
    assert there.relative.translation_rmse == pytest.approx(here.relative.translation_rmse)


def test_similarity_alignment_is_never_worse_than_rigid():
    truth = walk(2)
    error = trajectory_error(noisy(truth, 3, 0.5), truth, truth.path_length)

    assert error.sim3.rmse <= error.se3.rmse
    assert error.se3.alignment.T_target_source.scale == 1.0
    assert error.sim3.pct == pytest.approx(100 * error.sim3.rmse / truth.path_length)


def test_wrong_scale_shows_in_the_rigid_error_only():
    truth = walk(4)
    doubled = truth.transform(Sim3(np.eye(3), np.zeros(3), 2.0))

    error = trajectory_error(doubled, truth, truth.path_length)

    assert error.sim3.rmse < 1e-9
    assert error.se3.rmse > 0.1


def test_constant_turn_rate_error_is_the_relative_rotation_error():
    truth = walk(5)
    turned = Rotation.from_rotvec(np.radians(2.0) * np.arange(15)[:, None] * [0.0, 0.0, 1.0])
    estimate = Trajectory(
        truth.t_s,
        truth.positions,
        (Rotation.from_matrix(truth.R_wc) * turned).as_quat(scalar_first=True),
    )

    error = trajectory_error(estimate, truth, truth.path_length)

    assert error.relative.rotation_rmse_deg > 0.1
    assert error.sim3.rmse < 1e-9


def test_straight_path_gives_no_absolute_rotation_error():
    truth = walk(6)
    line = Trajectory(truth.t_s, np.outer(truth.t_s, [1.0, 2.0, 0.0]), truth.wxyz)

    error = trajectory_error(line, line, line.path_length)

    assert error.sim3.alignment.collinear
    assert error.rotation_rmse_deg is None


def test_positions_alone_give_the_same_absolute_error():
    truth, estimate = walk(7), noisy(walk(7), 8)

    full = trajectory_error(estimate, truth, truth.path_length)
    plain = position_error(estimate.positions, truth.positions, truth.path_length)

    assert plain.sim3.rmse == full.sim3.rmse
    assert plain.relative is None
    assert plain.drift_pct is None


def downward_survey(seed: int) -> Trajectory:
    """Pictures from above, in a world with z up, at changing heights."""
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal((1.0, 0.0, 0.0), 1.0, (12, 3)), axis=0)
    headings = Rotation.from_euler("z", rng.uniform(-180.0, 180.0, (12, 1)), degrees=True)
    looking_down = Rotation.from_euler("x", 180.0, degrees=True)
    wxyz = (headings * looking_down).as_quat(scalar_first=True)
    return Trajectory(np.arange(12) * 1.0, positions, wxyz)


@given(st.integers(0, 2**31), st.floats(0.05, 20.0))
def test_heights_of_a_survey_are_no_horizontal_error(seed, scale):
    survey = downward_survey(seed)

    moved = survey.transform(similarity(seed, scale))

    assert horizontal_error(moved, survey.positions[:, :2]) < 1e-6


def test_a_mirrored_survey_does_not_fit():
    survey = downward_survey(5)

    assert horizontal_error(survey, survey.positions[:, :2] * [1.0, -1.0]) > 0.1


def test_a_shift_of_one_position_is_a_horizontal_error():
    survey = downward_survey(6)
    truth = survey.positions[:, :2].copy()
    truth[5, 1] += 1.0

    assert 0.1 < horizontal_error(survey, truth) < 1.0 / np.sqrt(len(truth))
