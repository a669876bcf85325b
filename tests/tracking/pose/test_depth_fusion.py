"""Fusion: inverse variance, distrust, floors; and handing a pointmap to the next keyframe."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import triangulate
from aquaflow.keyframes import UNKNOWN_VARIANCE, KeyframeStore, Pointmap
from aquaflow.render.library import load_library
from aquaflow.tracking.pose import depth_fusion
from aquaflow.tracking.pose.depth_fusion import (
    DISAGREEMENT_INFLATION,
    FUSED_FLOOR,
    LEAST_CONFIDENCE,
    MEASUREMENT_FLOOR,
    MOST_FUSED,
    TRANSFER_INFLATION,
    fuse,
    fuse_by_numpy,
    fuse_compiled,
    transfer,
)
from tests.tracking.tracking_scenes import KnownPair, KnownView, depth_map, pose

Array = npt.NDArray[np.float64]

SMALL = CameraModel(60, 45, 50.0, 50.0, 30.0, 22.5)
T_WB = pose((0.01, 0.03, -0.02), (0.2, -0.03, 0.05))
T_BA = T_WB.inverse()
DEPTH = depth_map(SMALL, flat=False)
SIGMA_PX = 0.5


def two_views(noise_px: float = 0.0) -> KnownPair:
    a = KnownView(SMALL, Sim3.identity(), DEPTH)
    b = KnownView(SMALL, T_WB, depth_seen_from_b())
    return KnownPair(a, b, noise_px, SMALL)


def depth_seen_from_b() -> Array:
    """[H, W] depth of b's pixels: a's surface, found by fixed-point iteration."""
    rays = SMALL.unproject(SMALL.pixel_centres()) @ T_WB.R.T
    depth = np.full(DEPTH.shape, 1.5)
    for _ in range(60):
        X = T_WB.t + depth[..., None] * rays
        x, y = X[..., 0] / X[..., 2], X[..., 1] / X[..., 2]
        surface = 1.5 + 0.45 * np.sin(7.0 * x + 1.0) + 0.3 * np.cos(8.0 * y + 3.0 * x)
        depth = depth + 0.5 * (surface - X[..., 2])
    return depth


def measured(pair: KnownPair) -> tuple[Array, Array]:
    """[H, W] rho and variance that one fusion into nothing leaves."""
    pointmap = Pointmap.unknown(SMALL)
    fuse(pointmap, pair, T_BA, SMALL, SIGMA_PX)
    return pointmap.rho, pointmap.variance


def fused_with(rho: Array, variance: Array) -> Pointmap:
    pointmap = Pointmap(SMALL, rho.copy(), variance.copy())
    fuse(pointmap, two_views(), T_BA, SMALL, SIGMA_PX)
    return pointmap


@pytest.fixture(scope="module")
def first() -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """One measurement: rho, variance, and where there is one."""
    rho, variance = measured(two_views())
    return rho, variance, variance < UNKNOWN_VARIANCE


Measured = tuple[Array, Array, npt.NDArray[np.bool_]]


@pytest.mark.parametrize("seed", range(4))
def test_compiled_code_fuses_as_numpy_does(seed: int) -> None:
    """Over depths of every kind: unknown, distrusted, right, wrong; and matches of every kind."""
    random, pair = np.random.default_rng(seed), two_views(noise_px=0.3)
    shape = DEPTH.shape
    rho = np.where(random.random(shape) < 0.2, 0.0, random.lognormal(0.0, 0.2, shape) / DEPTH)
    variance = (random.choice([0.003, 0.05, 0.4, 2.0], shape) * rho) ** 2
    variance = np.where(random.random(shape) < 0.2, UNKNOWN_VARIANCE, variance)
    pair.matches[random.random(shape) < 0.05] = np.nan
    pair.matches[random.random(shape) < 0.05] += 40.0
    by_numpy, compiled = (Pointmap(SMALL, rho.copy(), variance.copy()) for _ in range(2))
    arguments = (pair, T_BA, SMALL, SIGMA_PX)
    with np.errstate(invalid="ignore"):
        expected = fuse_by_numpy(by_numpy, *arguments)
    assert fuse_compiled(load_library(), compiled, *arguments) == expected
    # Single precision; a pixel that was not measured keeps its numbers to the bit.
    np.testing.assert_allclose(compiled.rho, by_numpy.rho, rtol=1e-5)
    np.testing.assert_allclose(compiled.variance, by_numpy.variance, rtol=1e-4)
    untouched = (by_numpy.rho == rho) & (by_numpy.variance == variance)
    np.testing.assert_array_equal(compiled.rho[untouched], rho[untouched])
    np.testing.assert_array_equal(compiled.variance[untouched], variance[untouched])
    assert (compiled.rho != rho).mean() > 0.3


@pytest.mark.parametrize("baseline", [0.005, 0.02])
def test_single_precision_errs_by_a_hundredth_of_a_depths_sigma(baseline: float) -> None:
    """Also where parallax is hardly enough, and what is rounded is a small difference."""
    T_ba = Sim3(np.eye(3), np.array([-baseline, 0.1 * baseline, 0.2 * baseline]))
    seen = SMALL.project(T_ba.apply(SMALL.unproject(SMALL.pixel_centres()) * DEPTH[..., None]))
    pair = two_views()
    noise = np.random.default_rng(3).normal(0.0, 0.02, seen.shape)
    pair.matches, pair.valid = (seen + noise).astype(np.float32), np.ones(DEPTH.shape, bool)
    by_numpy, compiled = Pointmap.unknown(SMALL), Pointmap.unknown(SMALL)
    expected = fuse_by_numpy(by_numpy, pair, T_ba, SMALL, SIGMA_PX)
    measured = fuse_compiled(load_library(), compiled, pair, T_ba, SMALL, SIGMA_PX)
    assert expected > 0.1 * DEPTH.size
    assert abs(measured - expected) <= 0.002 * DEPTH.size  # at a limit, rounding decides
    both = (by_numpy.rho > 0.0) & (compiled.rho > 0.0)
    off = np.abs(compiled.rho - by_numpy.rho)[both]
    assert (off < 0.01 * np.sqrt(by_numpy.variance[both])).all()


def test_without_compiled_code_depths_are_fused_too(monkeypatch: pytest.MonkeyPatch) -> None:
    with_it = fused_with(1.0 / DEPTH, (0.1 / DEPTH) ** 2)
    monkeypatch.setattr(depth_fusion, "library_or_none", lambda: None)
    without = fused_with(1.0 / DEPTH, (0.1 / DEPTH) ** 2)
    np.testing.assert_allclose(without.rho, with_it.rho, rtol=1e-5)


def test_matches_of_another_picture_are_refused() -> None:
    other = Pointmap.unknown(CameraModel(30, 45, 50.0, 50.0, 15.0, 22.5))
    with pytest.raises(ValueError, match="matches is"):
        fuse(other, two_views(), T_BA, SMALL, SIGMA_PX)


def test_a_first_measurement_is_taken_as_it_is(first: Measured) -> None:
    rho, variance, known = first
    assert known.mean() > 0.5
    np.testing.assert_allclose(rho[known], 1.0 / DEPTH[known], rtol=1e-4)
    rays = SMALL.unproject(SMALL.pixel_centres())[known]
    pair = two_views()
    points = triangulate(rays, pair.matches[known].astype(float), T_BA, SMALL, SIGMA_PX)
    np.testing.assert_allclose(variance[known], points.variance, rtol=1e-5)
    assert not rho[~known].any()


def test_the_share_is_the_part_of_the_picture_that_was_measured(first: Measured) -> None:
    share = fuse(Pointmap.unknown(SMALL), two_views(), T_BA, SMALL, SIGMA_PX)
    assert share == pytest.approx(first[2].mean())


def test_agreeing_measurements_merge_by_inverse_variance(first: Measured) -> None:
    rho, variance, known = first
    old_rho, old_variance = rho * 1.01, variance * 2.0
    merged = fused_with(old_rho, old_variance)
    expected_variance = 1.0 / (1.0 / variance + 1.0 / old_variance)
    expected = expected_variance * (rho / variance + old_rho / old_variance)
    # The weights are those of the old depth, a hundredth off.
    np.testing.assert_allclose(merged.rho[known], expected[known], rtol=1e-4)
    np.testing.assert_allclose(merged.variance[known], expected_variance[known], rtol=0.02)


def test_a_measurement_of_low_confidence_weighs_less(first: Measured) -> None:
    pair = two_views()
    pair.C = (0.25 * pair.C).astype(np.float32)
    known = first[2]
    np.testing.assert_allclose(measured(pair)[1][known], 4.0 * first[1][known], rtol=1e-5)
    pair.C = np.zeros_like(pair.C)
    least = first[1][known] / LEAST_CONFIDENCE
    np.testing.assert_allclose(measured(pair)[1][known], least, rtol=1e-5)


def test_a_disagreement_keeps_the_depth_and_lowers_the_trust(first: Measured) -> None:
    rho, _, known = first
    old_rho, old_variance = rho * 2.0, np.full(rho.shape, 1e-4)
    kept = fused_with(old_rho, old_variance)
    far = known & (np.abs(old_rho - rho) > 3.5 * np.sqrt(first[1] + old_variance))
    assert far.mean() > 0.3
    np.testing.assert_array_equal(kept.rho[far], old_rho[far])
    grown = DISAGREEMENT_INFLATION * old_variance[far]
    np.testing.assert_allclose(kept.variance[far], grown, rtol=1e-6)


def test_a_depth_that_lost_all_trust_is_replaced(first: Measured) -> None:
    rho, variance, known = first
    old_rho = rho * 10.0
    replaced = fused_with(old_rho, (0.51 * old_rho) ** 2)
    np.testing.assert_allclose(replaced.rho[known], rho[known])
    np.testing.assert_allclose(replaced.variance[known], variance[known])


def test_no_single_measurement_is_trusted_beyond_its_floor() -> None:
    pointmap = Pointmap.unknown(SMALL)
    fuse(pointmap, two_views(), T_BA, SMALL, sigma_px=1e-6)
    known = pointmap.variance < UNKNOWN_VARIANCE
    np.testing.assert_allclose(
        np.sqrt(pointmap.variance[known]), MEASUREMENT_FLOOR * pointmap.rho[known], rtol=1e-6
    )


def test_no_fused_depth_is_trusted_beyond_its_floor() -> None:
    pointmap = Pointmap.unknown(SMALL)
    for _ in range(40):
        fuse(pointmap, two_views(), T_BA, SMALL, sigma_px=1e-6)
    known = pointmap.variance < UNKNOWN_VARIANCE
    least = FUSED_FLOOR * pointmap.rho[known]
    np.testing.assert_allclose(np.sqrt(pointmap.variance[known]), least, rtol=1e-6)


def test_a_pair_without_matches_changes_nothing() -> None:
    pair = two_views()
    pair.valid = np.zeros_like(pair.valid)
    pointmap = Pointmap.unknown(SMALL)
    assert fuse(pointmap, pair, T_BA, SMALL, SIGMA_PX) == 0.0
    assert (pointmap.variance == UNKNOWN_VARIANCE).all()


def test_a_pair_without_a_baseline_changes_nothing(first: Measured) -> None:
    rho, variance, _ = first
    pointmap = Pointmap(SMALL, rho.copy(), variance.copy())
    view = KnownView(SMALL, Sim3.identity(), DEPTH)
    share = fuse(pointmap, KnownPair(view, view, 0.0, SMALL), Sim3.identity(), SMALL, SIGMA_PX)
    assert share == 0.0
    np.testing.assert_array_equal(pointmap.rho, rho)
    np.testing.assert_array_equal(pointmap.variance, variance)


def test_many_noisy_measurements_become_one_good_depth() -> None:
    pointmap = Pointmap.unknown(SMALL)
    rng = np.random.default_rng(0)
    for _ in range(12):
        pair = two_views()
        pair.matches = pair.matches + rng.normal(0, 0.3, pair.matches.shape).astype(np.float32)
        fuse(pointmap, pair, T_BA, SMALL, SIGMA_PX)
    known = pointmap.is_known(0.1)
    error = np.abs(pointmap.rho * DEPTH - 1.0)[known]
    assert known.mean() > 0.5
    assert np.median(error) < 0.03


# --- transfer -------------------------------------------------------------------------------------


def moved_map(variance: float = 1e-4) -> tuple[Pointmap, KnownPair]:
    pair = two_views()
    pointmap = Pointmap(SMALL, 1.0 / DEPTH, np.full(DEPTH.shape, variance))
    return transfer(pointmap, pair.matches_back, pair.valid_back, T_BA, SMALL), pair


def test_a_transferred_depth_is_the_depth_that_the_other_view_sees() -> None:
    moved, pair = moved_map()
    truth = depth_seen_from_b()
    known = moved.variance < UNKNOWN_VARIANCE
    np.testing.assert_array_equal(known, pair.valid_back)
    error = np.abs(moved.rho * truth - 1.0)[known]
    assert np.median(error) < 0.02


def test_a_transferred_variance_grows_and_follows_the_depth() -> None:
    moved, _ = moved_map(1e-4)
    known = moved.variance < UNKNOWN_VARIANCE
    gain = moved.variance[known] / 1e-4 / TRANSFER_INFLATION
    assert 0.5 < np.median(gain) < 2.0
    further = moved.rho[known] < np.percentile(moved.rho[known], 30)
    flat = Pointmap(SMALL, np.ones(DEPTH.shape), np.full(DEPTH.shape, 1e-4))
    back = Sim3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    grid = SMALL.pixel_centres().astype(np.float32)
    twice_as_far = transfer(flat, grid, np.ones(DEPTH.shape, bool), back, SMALL)
    np.testing.assert_allclose(twice_as_far.rho, 0.5)
    np.testing.assert_allclose(twice_as_far.variance, 1e-4 * TRANSFER_INFLATION / 16.0)
    assert further.any()


def test_pixels_that_are_unreliable_or_unknown_stay_unknown() -> None:
    pointmap = Pointmap(SMALL, 1.0 / DEPTH, np.full(DEPTH.shape, 1e-4))
    pointmap.rho[:10], pointmap.variance[10:20] = 0.0, UNKNOWN_VARIANCE
    grid = SMALL.pixel_centres().astype(np.float32)
    reliable = np.ones(DEPTH.shape, bool)
    reliable[20:30] = False
    moved = transfer(pointmap, grid, reliable, Sim3.identity(), SMALL)
    assert not moved.is_known(10.0)[:30].any()
    np.testing.assert_allclose(moved.rho[30:], pointmap.rho[30:])


def test_points_behind_the_other_view_stay_unknown() -> None:
    pointmap = Pointmap(SMALL, 1.0 / DEPTH, np.full(DEPTH.shape, 1e-4))
    past = Sim3(np.eye(3), np.array([0.0, 0.0, -5.0]))
    grid = SMALL.pixel_centres().astype(np.float32)
    moved = transfer(pointmap, grid, np.ones(DEPTH.shape, bool), past, SMALL)
    assert not moved.rho.any()
    assert (moved.variance == UNKNOWN_VARIANCE).all()


def test_sources_outside_the_picture_take_the_border() -> None:
    pointmap = Pointmap(SMALL, 1.0 / DEPTH, np.full(DEPTH.shape, 1e-4))
    far = np.full((*DEPTH.shape, 2), 1e6, np.float32)
    moved = transfer(pointmap, far, np.zeros(DEPTH.shape, bool), Sim3.identity(), SMALL)
    assert not moved.rho.any()


# --- the pointmap itself --------------------------------------------------------------------------


def test_an_unknown_pointmap_knows_nothing() -> None:
    pointmap = Pointmap.unknown(SMALL)
    assert not pointmap.is_known(1.0).any()
    assert not pointmap.Q.any()
    assert np.isnan(pointmap.points()).all()


def test_the_point_confidence_is_one_over_the_relative_variance() -> None:
    pointmap = Pointmap(SMALL, np.full(DEPTH.shape, 0.5), np.full(DEPTH.shape, 0.01))
    np.testing.assert_allclose(pointmap.Q, 25.0)
    assert pointmap.is_known(0.21).all()
    assert not pointmap.is_known(0.19).any()
    pointmap.variance[:] = 0.0
    assert np.isfinite(pointmap.Q).all()


def test_points_lie_on_their_rays_at_their_depth() -> None:
    points = Pointmap(SMALL, 1.0 / DEPTH, np.ones(DEPTH.shape)).points()
    np.testing.assert_allclose(points[..., 2], DEPTH)
    np.testing.assert_allclose(SMALL.project(points), SMALL.pixel_centres())


def test_a_copy_is_not_changed_with_the_original() -> None:
    original = Pointmap.unknown(SMALL)
    copy = original.copy()
    original.rho[:], original.variance[:] = 1.0, 1.0
    assert not copy.rho.any()
    assert (copy.variance == UNKNOWN_VARIANCE).all()


def test_the_store_numbers_keyframes_in_order() -> None:
    store = KeyframeStore()
    view = KnownView(SMALL, Sim3.identity(), DEPTH)
    for index in (0, 7, 9):
        store.add(index, index * 10, view, Sim3.identity(), Pointmap.unknown(SMALL), 2)
    assert len(store) == 3
    assert [keyframe.number for keyframe in store.keyframes] == [0, 1, 2]
    assert (store[1].frame_index, store[1].t_ns, store[1].sub_map) == (7, 70, 2)


def test_a_pointmap_that_has_had_enough_frames_changes_no_more() -> None:
    pointmap, pair = Pointmap.unknown(SMALL), two_views()
    for _ in range(MOST_FUSED):
        assert fuse(pointmap, pair, T_BA, SMALL, SIGMA_PX) > 0.0
    rho, variance = pointmap.rho.copy(), pointmap.variance.copy()
    assert fuse(pointmap, two_views(noise_px=2.0), T_BA, SMALL, SIGMA_PX) == 0.0
    np.testing.assert_array_equal(pointmap.rho, rho)
    np.testing.assert_array_equal(pointmap.variance, variance)
    assert pointmap.fused == pointmap.copy().fused == MOST_FUSED
