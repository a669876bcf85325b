"""Compiled pose equations: the same numbers as the readable ones, for matches of every kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.render.library import load_library
from aquaflow.tracking.pose import solver
from aquaflow.tracking.pose.residuals import Matches, PoseProblem
from aquaflow.tracking.pose.solver import KERNEL, PixelEquations, RowEquations, solve_pose
from tests.tracking.tracking_scenes import cloud, pose, problem_of

TRUTH = pose((0.05, -0.08, 0.1), (-0.15, 0.06, 0.1))
POSES = (TRUTH, Sim3.identity(), pose((0.1, 0.0, -0.3), (0.0, 0.0, -1.2)))
"""The last one leaves part of the points behind the camera."""


def problem(seed: int, around: bool, count: int = 700) -> PoseProblem:
    """Outliers, uncertain depths and matches, and some that are no number."""
    random = np.random.default_rng(seed)
    exact = problem_of(cloud(seed, count), TRUTH, seed, noise_px=0.5)
    exact.pixels[random.random(count) < 0.2] += 30.0
    exact.pixels[random.random(count) < 0.05] = np.nan
    rho = 1.0 / exact.points[:, 2]
    return replace(
        exact,
        rho_variance=(random.choice([0.0, 0.02, 0.3], count) * rho) ** 2,
        weights=random.random(count),
        around_rho=rho * random.lognormal(0.0, 0.05, count) if around else None,
    )


@pytest.mark.parametrize("around", [True, False])
@pytest.mark.parametrize("at", POSES)
def test_compiled_equations_are_those_of_the_rows(at: Sim3, around: bool) -> None:
    matches = Matches(problem(1, around), "pixel", free_scale=False)
    compiled = PixelEquations(load_library(), matches, KERNEL.bound)
    readable = RowEquations(matches, "pixel")
    for found, expected in zip(compiled.at(at), readable.at(at), strict=True):
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * scale)
    for found, expected in zip(
        compiled.residuals_and_pulls(at), readable.residuals_and_pulls(at), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("count", [1, 127, 128, 129])
def test_blocks_that_are_not_full_count_too(count: int) -> None:
    matches = Matches(problem_of(cloud(2, count), TRUTH), "pixel", free_scale=False)
    H, _, _ = PixelEquations(load_library(), matches, KERNEL.bound).at(TRUTH)
    expected = RowEquations(matches, "pixel").at(TRUTH)[0]
    np.testing.assert_allclose(H, expected, atol=1e-12 * np.abs(expected).max())


def test_without_compiled_code_the_pose_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    with_it = solve_pose(problem(3, around=True), Sim3.identity())
    monkeypatch.setattr(solver, "library_or_none", lambda: None)
    without = solve_pose(problem(3, around=True), Sim3.identity())
    assert with_it is not None
    assert without is not None
    np.testing.assert_allclose(with_it.T.t, without.T.t, atol=1e-12)
    np.testing.assert_allclose(with_it.covariance, without.covariance, rtol=1e-7)
    assert with_it.inlier_share == without.inlier_share
