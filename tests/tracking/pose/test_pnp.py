"""Pose from scratch: found without a prediction, None without consensus."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.similarity import so3_log
from aquaflow.tracking.pose.matcher import MIN_INLIERS, pose_from_scratch
from tests.tracking.tracking_scenes import cloud, pose, problem_of

FAR = pose((0.3, -0.4, 1.0), (-0.5, 0.3, 0.2))


@pytest.mark.parametrize("outliers", [0.0, 0.4])
def test_a_far_pose_is_found_without_a_prediction(outliers: float) -> None:
    problem = problem_of(cloud(0, 500), FAR, noise_px=0.3)
    rng = np.random.default_rng(1)
    bad = rng.random(500) < outliers
    problem.pixels[bad] = rng.uniform(0, 240, (int(bad.sum()), 2))
    found = pose_from_scratch(problem)
    assert found is not None
    assert np.linalg.norm(found.t - FAR.t) < 0.02
    assert np.linalg.norm(so3_log(found.R @ FAR.R.T)) < 0.02
    assert found.scale == 1.0


def test_matches_without_consensus_give_no_pose() -> None:
    problem = problem_of(cloud(2, 300), FAR)
    problem.pixels[:] = np.random.default_rng(3).uniform(0, 240, problem.pixels.shape)
    assert pose_from_scratch(problem) is None


def test_too_few_matches_give_no_pose() -> None:
    assert pose_from_scratch(problem_of(cloud(4, MIN_INLIERS - 1), FAR)) is None
    assert pose_from_scratch(problem_of(cloud(4, MIN_INLIERS + 20), FAR)) is not None


def test_matches_that_are_no_numbers_give_no_pose() -> None:
    problem = problem_of(cloud(5, 100), FAR)
    problem.pixels[:] = np.nan
    assert pose_from_scratch(problem) is None
    problem = problem_of(cloud(5, 100), FAR)
    problem.points[:] = np.nan
    assert pose_from_scratch(problem) is None


@pytest.mark.parametrize("scale", [1.0, 1e-12])
def test_points_on_a_line_on_which_sqpnp_raises_give_no_pose(scale: float) -> None:
    line = np.linspace(-0.5, 0.5, 100)[:, None] * [[1.0, 0.5, 0.2]] + [[0.0, 0.0, 5.0]]
    assert pose_from_scratch(problem_of(scale * line, FAR)) is None


def test_a_pose_is_found_although_samples_on_which_sqpnp_raises_are_drawn() -> None:
    points = np.concatenate([np.repeat(cloud(7, 1), 150, axis=0), cloud(8, 60)])
    assert pose_from_scratch(problem_of(np.repeat(points[:1], 100, axis=0), FAR)) is None
    found = pose_from_scratch(problem_of(points, FAR))
    assert found is not None
    assert np.linalg.norm(found.t - FAR.t) < 0.02


def test_one_point_repeated_raises_nothing() -> None:
    problem = problem_of(np.repeat(cloud(6, 1), 100, axis=0), FAR)
    found = pose_from_scratch(problem)
    assert found is None or found.is_finite()
