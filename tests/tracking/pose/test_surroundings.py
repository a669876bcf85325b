"""What poses are solved with and selected by does not share the noise of the depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.pose.matcher import pose_problem, surroundings
from aquaflow.tracking.pose.solver import solve_pose
from tests.tracking.tracking_scenes import CAMERA, Array, depth_map, pose

FORWARD = pose((0.002, -0.001, 0.001), (0.004, 0.008, -0.06))
"""T_fk of a camera that went forward by a twenty-fifth of the depth."""


def noisy(seed: int, depth: Array, sigma: float, stated: float) -> Pointmap:
    """A pointmap whose inverse depths err by the relative ``sigma``."""
    rng = np.random.default_rng(seed)
    rho = 1.0 / depth
    variance = (stated * rho) ** 2
    return Pointmap(CAMERA, rho + sigma * rho * rng.normal(size=rho.shape), variance)


def translation(seed: int, separate: bool) -> float:
    """Estimated over true length of ``FORWARD``. Depths err by 10 % and are said to err by 3 %, as
    those are that were fused from matches with errors in common."""
    rng = np.random.default_rng(seed)
    depth = depth_map(CAMERA, flat=False)
    pointmap = noisy(seed, depth, 0.1, 0.03)
    rows, columns = (each.ravel() for each in np.mgrid[4:180:3, 4:240:3])
    pixels_k = np.stack([columns + 0.5, rows + 0.5], -1)
    points = CAMERA.unproject(pixels_k) * depth[rows, columns, None]
    pixels = CAMERA.project(FORWARD.apply(points)) + rng.normal(0.0, 0.2, pixels_k.shape)
    problem = pose_problem(pointmap, pixels_k, pixels, CAMERA, 0.2)
    if separate:
        around, _ = surroundings(pointmap, 0.15)
        problem = replace(problem, around_rho=around[rows, columns].astype(np.float64))
    estimate = solve_pose(problem, Sim3.identity())
    assert estimate is not None
    return float(np.linalg.norm(estimate.T.t) / np.linalg.norm(FORWARD.t))


def test_a_pixels_own_error_is_not_in_what_is_around_it() -> None:
    pointmap = Pointmap(CAMERA, np.full((180, 240), 0.5), np.full((180, 240), 1e-6))
    pointmap.rho[100:104, 120:124] = 0.8
    around, _ = surroundings(pointmap, 0.15)
    assert np.allclose(around[100:104, 120:124], 0.5)
    assert around[100, 130] > 0.5


def test_where_nothing_is_known_around_it_is_the_pixels_own() -> None:
    pointmap = Pointmap.unknown(CAMERA)
    pointmap.rho[90, 120], pointmap.variance[90, 120] = 0.4, 1e-6
    around, known = surroundings(pointmap, 0.15)
    assert np.isclose(around[90, 120], 0.4)
    assert known[90, 120]
    assert known.sum() == 1


def test_noise_does_not_select_its_points() -> None:
    """Depths as uncertain as the limit: by their own value, the nearer ones are taken."""
    pointmap = noisy(0, np.full((180, 240), 2.0), 0.15, 0.15)
    _, known = surroundings(pointmap, 0.15)
    own = pointmap.is_known(0.15)
    assert abs(2.0 * pointmap.rho[known].mean() - 1.0) < 0.01
    assert 2.0 * pointmap.rho[own].mean() > 1.1


def test_depths_that_are_worse_than_stated_shorten_no_translation() -> None:
    separate = np.mean([translation(seed, True) for seed in range(8)])
    assert abs(separate - 1.0) < 0.003
    shared = np.mean([translation(seed, False) for seed in range(8)])
    assert shared < 0.993
