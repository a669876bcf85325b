"""The coarse start: a homography from SIFT, or nothing where the pictures do not match."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.prior.flow import normalised_grey
from aquaflow.prior.homography import (
    MIN_INLIERS,
    Keypoints,
    detect,
    flow_of_homography,
    homography,
)
from tests.prior.textured_pictures import (
    HEIGHT,
    WIDTH,
    inside,
    mapped,
    moved_pair,
    pixel_centres,
    shift,
)


def test_a_large_rotated_and_scaled_motion_is_found() -> None:
    c, s = 1.1 * np.cos(0.5), 1.1 * np.sin(0.5)
    H = np.array([[c, -s, 70.0], [s, c, -40.0], [0.0, 0.0, 1.0]])
    a, b = (detect(normalised_grey(image)) for image in moved_pair(H))
    found = homography(a, b)
    assert found is not None
    grid = pixel_centres()
    seen = inside(mapped(H, grid), 0.0)
    error = np.linalg.norm(mapped(found, grid) - mapped(H, grid), axis=-1)[seen]
    assert error.max() < 1.5


@pytest.mark.parametrize("value", [0, 128])
def test_a_picture_of_one_colour_has_no_keypoints(value: int) -> None:
    empty = detect(np.full((HEIGHT, WIDTH), value, np.uint8))
    assert empty.pixels.shape == (0, 2)
    assert empty.descriptors.shape == (0, 128)
    assert homography(empty, empty) is None


def test_pictures_of_different_places_give_no_homography() -> None:
    (a, _), (b, _) = moved_pair(shift(0, 0), seed=0), moved_pair(shift(0, 0), seed=1)
    assert homography(detect(normalised_grey(a)), detect(normalised_grey(b))) is None


def test_too_few_keypoints_on_either_side_give_no_homography() -> None:
    full = detect(normalised_grey(moved_pair(shift(0, 0))[0]))
    few = Keypoints(full.pixels[: MIN_INLIERS - 1], full.descriptors[: MIN_INLIERS - 1])
    assert homography(full, full) is not None
    assert homography(full, few) is None
    assert homography(few, full) is None


def test_descriptors_that_all_look_alike_give_no_homography() -> None:
    full = detect(normalised_grey(moved_pair(shift(0, 0))[0]))
    alike = Keypoints(full.pixels, np.ones_like(full.descriptors))
    assert homography(alike, alike) is None


def test_matches_that_agree_on_no_homography_give_none() -> None:
    full = detect(normalised_grey(moved_pair(shift(0, 0))[0]))
    count = 40
    one = Keypoints(full.pixels[:count], full.descriptors[:count])
    scattered = np.random.default_rng(0).uniform(0, 1e4, (count, 2)).astype(np.float32)
    assert homography(one, Keypoints(scattered, one.descriptors)) is None


def test_the_flow_of_a_homography_moves_every_pixel_by_it() -> None:
    H = np.array([[1.02, 0.1, 3.0], [-0.05, 0.95, 7.0], [2e-4, 0.0, 1.0]])
    flow = flow_of_homography(H, HEIGHT, WIDTH)
    grid = pixel_centres()
    np.testing.assert_allclose(flow, mapped(H, grid) - grid, atol=1e-3)


def test_the_flow_stays_finite_across_the_horizon_of_the_plane() -> None:
    through_the_middle = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, -120.5]])
    flow = flow_of_homography(through_the_middle, HEIGHT, WIDTH)
    assert np.isfinite(flow).all()
    assert np.abs(flow).max() <= 2.0 * (HEIGHT + WIDTH)
