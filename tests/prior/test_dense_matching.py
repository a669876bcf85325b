"""Matches by points and descriptors: exact where both are, and no worse for bad neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior import dense_matching as matching
from aquaflow.prior.dense_matching import DenseViews
from aquaflow.prior.flow import pixel_grid

CAMERA = CameraModel(64, 48, 55.0, 55.0, 32.0, 24.0)
MOVED = np.array([0.12, -0.08, 0.15])
"""Of the points, from a's frame to b's."""
GRID = pixel_grid(48, 64)


def surface() -> np.ndarray:
    """[48, 64, 3] points of a wavy wall, seen by the camera that it stands before."""
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    x, y = rays[..., 0], rays[..., 1]
    return rays * (2.0 + 0.2 * np.sin(4.0 * x) * np.cos(3.0 * y))[..., None]


def described(points: np.ndarray) -> np.ndarray:
    """[48, 64, 32] descriptors of places, alike over two pixels and over ten."""
    rng = np.random.default_rng(3)
    widths = np.repeat([0.08, 0.4], 8)
    phase = points @ (rng.normal(size=(3, 16)) / widths)
    return (np.concatenate([np.cos(phase), np.sin(phase)], -1) / 4.0).astype(np.float32)


def views() -> DenseViews:
    """b's own points are those of its rays on the same wall, found to where they are exact."""
    in_a = surface()
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    depth = np.full(rays.shape[:2], 2.0)
    for _ in range(30):
        there = rays * depth[..., None] - MOVED
        x, y = there[..., 0] / there[..., 2], there[..., 1] / there[..., 2]
        depth = 2.0 + 0.2 * np.sin(4.0 * x) * np.cos(3.0 * y) + MOVED[2]
    in_b = rays * depth[..., None]
    descriptors = described(in_a), described(in_b - MOVED)
    return DenseViews((in_a + MOVED).astype("f4"), in_b.astype("f4"), *descriptors)


def truth() -> tuple[np.ndarray, np.ndarray]:
    pixels = CAMERA.project(surface() + MOVED)
    return pixels, ((pixels > 1.0) & (pixels < [63.0, 47.0])).all(-1)


def errors(given: DenseViews) -> np.ndarray:
    (pixels, seen), (found, known) = truth(), given.match()
    return np.asarray(np.linalg.norm(found - pixels, axis=-1)[seen & known])


def test_the_jacobian_of_a_ray_is_what_small_steps_show() -> None:
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(9, 11, 3))
    at = rng.integers(0, 8, (50, 2)) + rng.uniform(0.1, 0.9, (50, 2))
    _, jacobian = matching.ray_and_jacobian(rays, at)
    for axis in (0, 1):
        step = 1e-6 * np.eye(2)[axis]
        ahead, _ = matching.ray_and_jacobian(rays, at + step)
        behind, _ = matching.ray_and_jacobian(rays, at - step)
        np.testing.assert_allclose(jacobian[..., axis], (ahead - behind) / 2e-6, atol=1e-8)


def test_exact_points_are_found_to_a_hundredth_of_a_pixel() -> None:
    given = views()
    rays, _ = matching.ray_image(given.points_b)
    wanted, _ = matching.unit_rays(given.points_a)
    pixels, off = matching.project(rays, wanted, GRID)
    expected, seen = truth()
    assert np.abs(pixels - expected)[seen].max() < 0.01
    assert off[seen].max() < 0.01


@pytest.mark.parametrize("threads", [1, 3])
def test_the_compiled_matcher_is_its_readable_reference(threads: int) -> None:
    given = views()
    rays, _ = matching.ray_image(given.points_b)
    wanted, _ = matching.unit_rays(given.points_a)
    wanted[3, 4:9] = np.nan
    start = GRID + np.float32([30.0, -4.0])
    start[5, 6] = np.nan
    (pixels, off), (expected, expected_off) = (
        matching.project(rays, wanted, start, threads),
        matching.project_by_numpy(rays, wanted, start),
    )
    sought = np.isfinite(wanted).all(-1)
    np.testing.assert_array_equal(np.isfinite(off), sought)
    np.testing.assert_allclose(pixels[sought], expected[sought], atol=2.0 * matching.STILL_PX)
    np.testing.assert_allclose(off[sought], expected_off[sought], atol=2.0 * matching.STILL_PX)
    near = expected + np.random.default_rng(0).normal(0.0, 4.0, expected.shape).astype("f4")
    found = matching.search(near, given.descriptors_a, given.descriptors_b, threads)
    reference = matching.search_by_numpy(near, given.descriptors_a, given.descriptors_b)
    for one, other in zip(found, reference, strict=True):
        assert (np.abs(one - other) > 1e-3).mean() < 0.002, "but for products that are equal"


def test_descriptors_mend_points_that_are_pixels_off() -> None:
    given = views()
    off = given.points_a + np.float32([0.15, -0.1, 0.0])
    assert np.median(errors(replace(given, points_a=off))) < 0.25
    nothing = np.full_like(given.descriptors_a, 0.2)
    alone = replace(given, points_a=off, descriptors_a=nothing, descriptors_b=nothing)
    assert np.median(errors(alone)) > 3.0


def test_descriptors_that_are_all_alike_leave_the_match_where_the_points_say() -> None:
    given = views()
    same = np.full_like(given.descriptors_a, 0.2)
    found = errors(replace(given, descriptors_a=same, descriptors_b=same))
    assert np.median(found) < 0.02


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1e30])
@pytest.mark.parametrize("field", ["points_a", "points_b", "descriptors_a", "descriptors_b"])
def test_bad_numbers_cost_their_own_matches_only(field: str, bad: float) -> None:
    given = views()
    whole, whole_known = given.match()
    spoiled = np.array(getattr(given, field))
    spoiled[10:14, 20:26] = bad
    given = replace(given, **{field: spoiled})
    found, known = given.match()
    assert np.isfinite(found).all()
    flow = given.flow(48, 64)
    assert flow is not None
    assert np.isfinite(flow).all()
    at = whole if field.endswith("b") else GRID
    near = (np.abs(at - [23.0, 12.0]) < [12.0, 11.0]).all(-1)
    np.testing.assert_allclose(found[~near], whole[~near], atol=0.05)
    np.testing.assert_array_equal(known[~near], whole_known[~near])


def test_nothing_is_known_of_pictures_without_overlap() -> None:
    given = views()
    aside = replace(given, points_a=given.points_a + np.float32([50.0, 0.0, 0.0]))
    nowhere = replace(given, points_b=np.full_like(given.points_b, np.nan))
    for each in (aside, nowhere):
        assert not each.match()[1].any()
        assert each.flow(48, 64) is None


def test_what_is_hidden_is_not_matched() -> None:
    given = views()
    wall = given.points_b.copy()
    wall[:, :20] *= 0.4
    _, known = replace(given, points_b=wall).match()
    pixels, seen = truth()
    behind = seen & (pixels[..., 0] < 12.0)
    assert behind.any()
    assert not known[behind].any()


def test_the_flow_is_that_of_pictures_of_another_size_and_of_most_of_their_matches() -> None:
    given = views()
    wrong = given.points_a.copy()
    rng = np.random.default_rng(0)
    wrong[rng.random(wrong.shape[:2]) < 0.15] += np.float32([0.4, 0.3, 0.0])
    flow = replace(given, points_a=wrong).flow(96, 128)
    assert flow is not None
    assert flow.shape == (96, 128, 2)
    pixels, seen = truth()
    moved = 2.0 * (pixels - GRID)
    middle = flow.reshape(48, 2, 64, 2, 2).mean((1, 3))
    error = np.linalg.norm(middle - moved, axis=-1)[seen]
    assert np.median(error) < 0.5
    assert np.percentile(error, 90) < 2.0


def test_pictures_of_different_sizes_are_matched() -> None:
    given = views()
    a, described_a = (matching.thinned(field, 2) for field in (given.points_a, given.descriptors_a))
    half = replace(given, points_a=a, descriptors_a=described_a)
    found, known = half.match()
    pixels, seen = (field[1::2, 1::2] for field in truth())
    assert np.median(np.linalg.norm(found - pixels, axis=-1)[seen & known]) < 0.2
