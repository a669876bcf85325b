"""Handing a pointmap over between pixels: exact on a plane, honest at a depth edge."""

from __future__ import annotations

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import UNKNOWN_VARIANCE, Pointmap
from aquaflow.tracking.pose.depth_fusion import transfer

SMALL = CameraModel(60, 45, 50.0, 50.0, 30.0, 22.5)
SHAPE = (45, 60)


def test_a_plane_is_transferred_exactly_between_pixels() -> None:
    grid = SMALL.pixel_centres()
    rays = SMALL.unproject(grid)
    plane = Pointmap(SMALL, rays @ np.array([0.2, 0.5, 0.6]), np.full(SHAPE, 1e-4))
    between = (grid + np.array([0.37, -0.21])).astype(np.float32)
    inner = np.zeros(SHAPE, bool)
    inner[1:-1, 1:-1] = True
    moved = transfer(plane, between, inner, Sim3.identity(), SMALL)
    expected = SMALL.unproject(between.astype(np.float64)) @ np.array([0.2, 0.5, 0.6])
    np.testing.assert_allclose(moved.rho[inner], expected[inner], rtol=1e-6)


def test_a_depth_between_two_surfaces_is_known_no_better_than_they_differ() -> None:
    rho = np.where(np.arange(60) < 30, 1.0, 0.5) * np.ones((45, 1))
    step = Pointmap(SMALL, rho, np.full(SHAPE, 1e-8))
    grid = SMALL.pixel_centres().astype(np.float32)
    everywhere = np.ones(SHAPE, bool)
    moved = transfer(step, grid + np.float32([0.5, 0.0]), everywhere, Sim3.identity(), SMALL)
    sigma = np.sqrt(moved.variance[:, 29])
    np.testing.assert_allclose(sigma, 0.25, rtol=1e-3)
    assert not moved.is_known(0.15)[:, 29].any()
    assert moved.is_known(0.15)[:, :28].all()


def test_a_depth_needs_a_known_pixel_near() -> None:
    rho = np.zeros(SHAPE)
    rho[20, 30] = 1.0
    variance = np.where(rho > 0.0, 1e-4, UNKNOWN_VARIANCE)
    grid = SMALL.pixel_centres().astype(np.float32)
    everywhere = np.ones(SHAPE, bool)
    for off, known in ((0.4, 1), (0.6, 0)):
        moved = transfer(
            Pointmap(SMALL, rho.copy(), variance.copy()),
            grid + np.float32([off, off]),
            everywhere & (rho > 0.0),
            Sim3.identity(),
            SMALL,
        )
        assert moved.is_known(0.15).sum() == known
