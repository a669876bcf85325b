"""Triangulation: exact without noise, honest about its variance, finite at its limits."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.geometry.two_view import Triangulation, triangulate

Array = npt.NDArray[np.float64]

CAMERA = CameraModel(320, 240, 260.0, 260.0, 160.0, 120.0)
SIDEWAYS = Sim3(so3_exp(np.array([0.01, -0.03, 0.02])), np.array([-0.2, 0.03, 0.02]))
NOISE_PX = 0.5
MONTE_CARLO = 400


def scene(seed: int, count: int = 60) -> tuple[Array, Array]:
    """Rays [M, 3] at z = 1 in a, and depths [M]."""
    rng = np.random.default_rng(seed)
    pixels = np.stack([rng.uniform(20, 300, count), rng.uniform(20, 220, count)], -1)
    return CAMERA.unproject(pixels), rng.uniform(1.0, 3.0, count)


def seen(rays: Array, depth: Array, T_ba: Sim3) -> Array:
    return CAMERA.project(T_ba.apply(rays * depth[:, None]))


def assert_finite(points: Triangulation) -> None:
    for values in (points.rho, points.variance, points.sin_parallax):
        assert np.isfinite(values).all()


@given(st.integers(0, 2**31))
def test_depths_are_exact_without_noise(seed: int) -> None:
    rays, depth = scene(seed)
    points = triangulate(rays, seen(rays, depth, SIDEWAYS), SIDEWAYS, CAMERA, NOISE_PX)
    assert points.good.all()
    np.testing.assert_allclose(1.0 / points.rho, depth, rtol=1e-9)


@given(st.floats(1e-4, 1e4))
def test_depths_are_in_the_unit_of_the_first_view_whatever_that_of_the_second_is(
    scale: float,
) -> None:
    rays, depth = scene(0)
    T_ba = Sim3(SIDEWAYS.R, scale * SIDEWAYS.t, scale)
    points = triangulate(rays, seen(rays, depth, T_ba), T_ba, CAMERA, NOISE_PX)
    assert points.good.all()
    np.testing.assert_allclose(1.0 / points.rho, depth, rtol=1e-9)
    plain = triangulate(rays, seen(rays, depth, SIDEWAYS), SIDEWAYS, CAMERA, NOISE_PX)
    np.testing.assert_allclose(points.variance, plain.variance, rtol=1e-6)


def test_the_parallax_is_the_angle_between_the_rays() -> None:
    rays, depth = scene(0)
    points = triangulate(rays, seen(rays, depth, SIDEWAYS), SIDEWAYS, CAMERA, NOISE_PX)
    X = rays * depth[:, None]
    from_b = X + SIDEWAYS.R.T @ SIDEWAYS.t
    cosine = (X * from_b).sum(1) / np.linalg.norm(X, axis=1) / np.linalg.norm(from_b, axis=1)
    np.testing.assert_allclose(points.sin_parallax, np.sqrt(1.0 - cosine**2), atol=1e-7)


def test_the_stated_variance_is_the_spread_under_noise() -> None:
    rays, depth = scene(1, 40)
    exact = seen(rays, depth, SIDEWAYS)
    rng = np.random.default_rng(2)
    found = np.stack(
        [
            triangulate(
                rays, exact + rng.normal(0, NOISE_PX, exact.shape), SIDEWAYS, CAMERA, NOISE_PX
            ).rho
            for _ in range(MONTE_CARLO)
        ]
    )
    stated = triangulate(rays, exact, SIDEWAYS, CAMERA, NOISE_PX).variance
    ratio = found.std(0) / np.sqrt(stated)
    assert 0.8 < np.median(ratio) < 1.25
    assert (ratio > 0.6).all()
    assert (ratio < 1.6).all()


def test_without_a_baseline_nothing_is_good_and_all_is_finite() -> None:
    rays, depth = scene(3)
    turned = Sim3(so3_exp(np.array([0.0, 0.1, 0.0])), np.zeros(3))
    points = triangulate(rays, seen(rays, depth, turned), turned, CAMERA, NOISE_PX)
    assert not points.good.any()
    assert_finite(points)


def test_points_at_infinity_are_not_good_and_finite() -> None:
    rays, _ = scene(4)
    at_infinity = CAMERA.project(rays @ SIDEWAYS.R.T)
    points = triangulate(rays, at_infinity, SIDEWAYS, CAMERA, NOISE_PX)
    assert not points.good.any()
    assert_finite(points)


def test_too_little_parallax_is_not_good_though_the_depth_is_right() -> None:
    rays, _ = scene(5)
    far = np.full(len(rays), 200.0)
    points = triangulate(rays, seen(rays, far, SIDEWAYS), SIDEWAYS, CAMERA, NOISE_PX)
    assert not points.good.any()
    np.testing.assert_allclose(points.rho, 1.0 / far, rtol=1e-6)


def test_points_behind_the_first_camera_are_not_good() -> None:
    rays, depth = scene(6)
    behind = SIDEWAYS.apply(rays * -depth[:, None])
    pixels = CAMERA.K[:2, :2] @ (behind[:, :2] / behind[:, 2:]).T
    points = triangulate(rays, pixels.T + CAMERA.K[:2, 2], SIDEWAYS, CAMERA, NOISE_PX)
    assert not points.good.any()
    assert_finite(points)


def test_points_behind_the_second_camera_are_not_good() -> None:
    rays = CAMERA.unproject(np.array([[150.0, 110.0], [170.0, 130.0]]))
    past = Sim3(np.eye(3), np.array([0.2, 0.1, -3.0]))
    Y = past.apply(2.0 * rays)
    assert (Y[:, 2] < 0).all()
    pixels = Y[:, :2] / Y[:, 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
    points = triangulate(rays, pixels, past, CAMERA, NOISE_PX)
    np.testing.assert_allclose(points.rho, 0.5)
    assert not points.good.any()
    assert_finite(points)


@pytest.mark.parametrize(("off_px", "good"), [(1.0, True), (2.5, False)])
def test_a_match_off_its_epipolar_line_is_no_measurement(off_px: float, good: bool) -> None:
    sideways = Sim3(np.eye(3), np.array([-0.2, 0.0, 0.0]))
    rays, depth = scene(7)
    pixels = seen(rays, depth, sideways) + np.array([0.0, off_px])
    points = triangulate(rays, pixels, sideways, CAMERA, NOISE_PX)
    assert (points.good == good).all()


def test_no_matches_give_no_points() -> None:
    points = triangulate(np.zeros((0, 3)), np.zeros((0, 2)), SIDEWAYS, CAMERA, NOISE_PX)
    assert points.good.shape == points.rho.shape == (0,)


def test_far_points_come_out_neither_near_nor_far_under_noise() -> None:
    """A depth of 30 baselines, half a pixel of noise on six of parallax: solved for the depth
    itself, the mean inverse depth would be 0.7 % too large."""
    count = 40_000
    rays = np.broadcast_to([0.1, -0.2, 1.0], (count, 3))
    T_ba = Sim3(np.eye(3), np.array([-0.14, 0.0, 0.0]))
    exact = seen(rays, np.full(count, 6.0), T_ba)
    noisy = exact + np.random.default_rng(0).normal(0.0, NOISE_PX, exact.shape)
    points = triangulate(rays, noisy, T_ba, CAMERA, NOISE_PX)
    assert float((6.0 * points.rho).mean()) == pytest.approx(1.0, abs=0.002)


def test_weights_come_from_the_expected_depth_and_not_from_the_noise() -> None:
    """Ahead of a vehicle that swims forward, what noise puts nearer would also look surer."""
    forward = Sim3(np.eye(3), np.array([0.0, 0.0, -0.4]))
    rays = np.broadcast_to([0.3, 0.2, 1.0], (2, 3))
    depth = np.array([2.0, 3.0])
    pixels = seen(rays, depth, forward)
    expected = np.full(2, 1.0 / 2.5)
    variance = triangulate(rays, pixels, forward, CAMERA, NOISE_PX, expected).variance
    own = triangulate(rays, pixels, forward, CAMERA, NOISE_PX).variance
    assert variance[0] == pytest.approx(variance[1])
    assert own[0] != pytest.approx(own[1])
    unknown = triangulate(rays, pixels, forward, CAMERA, NOISE_PX, np.zeros(2)).variance
    np.testing.assert_array_equal(unknown, own)
