"""Self-calibration on exact geometry: the lens is found, its sigma is true, and motion that does
not determine it leaves the guess."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.camera import CameraModel, guess_camera
from aquaflow.geometry.optics import LENS_PRIOR_SIGMA
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.prior.contract import Keypoints
from aquaflow.tracking.lens_equations import MIN_PAIR_MATCHES, LensView, match_pixels
from aquaflow.tracking.self_calibration import (
    LAST_SPACING,
    MIN_VIEWS,
    MOST_VIEWS,
    LensViews,
    estimate,
    found_lens,
    motion,
    pairs_of,
)
from tests.tracking.lens_scenes import swim

GUESS = guess_camera(480, 360)
NOTHING = Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 4), np.float32))


@pytest.mark.parametrize("lens", [(0.25, 0.1), (-0.3, 0.0), (0.1, -0.1)])
def test_focal_length_and_distortion_are_found_from_a_guess_far_off(
    lens: tuple[float, float],
) -> None:
    found = estimate(*swim(lens, views=10, reach=4))

    assert found.known
    error = found.lens[:2] - lens
    assert np.abs(error).max() < 0.01
    assert (np.abs(error) < 3.0 * found.sigma).all()
    assert found.camera(GUESS).fx == pytest.approx(GUESS.fx * np.exp(lens[0]), rel=0.01)
    assert found.camera(GUESS).distortion[0] == pytest.approx(lens[1], abs=0.01)


def test_the_stated_sigma_is_the_spread() -> None:
    errors = []
    for seed in range(6):
        found = estimate(*swim((0.05, 0.05), turning=0.03, views=8, seed=seed, reach=4))
        errors.append((found.lens[:2] - 0.05) / found.sigma)

    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_sideways_motion_over_a_plane_leaves_the_guess_and_says_so() -> None:
    found = estimate(*swim((0.1, 0.0), turning=0.0, relief=0.0, views=8))

    assert not found.known
    assert abs(found.lens[0]) < 2.0 * LENS_PRIOR_SIGMA[0]


def test_too_few_views_or_matches_find_nothing() -> None:
    few = [LensView(NOTHING, GUESS, Sim3.identity())] * (MIN_VIEWS - 1)
    assert found_lens(few) is None
    assert found_lens([*few, few[0]]) is None


def test_distant_views_are_matched_too() -> None:
    assert (0, 1) in pairs_of(20)
    assert (0, 13) in pairs_of(20)
    assert max(j for _, j in pairs_of(20)) == 19


# --- matches --------------------------------------------------------------------------------------


def view(pixels: np.ndarray, descriptors: np.ndarray) -> LensView:
    keypoints = Keypoints(pixels.astype(np.float32), descriptors.astype(np.float32))
    return LensView(keypoints, CameraModel(480, 360, 400, 400, 240, 180), Sim3.identity())


def test_pictures_of_different_places_do_not_match() -> None:
    rng = np.random.default_rng(0)
    pixels, seen = rng.uniform(0, 300, (400, 2)), rng.normal(size=(400, 64))
    other = rng.normal(size=(400, 64))
    other[: MIN_PAIR_MATCHES - 1] = seen[: MIN_PAIR_MATCHES - 1]

    found = match_pixels(
        [view(pixels, seen), view(pixels, seen), view(pixels, other)], [(0, 1), (0, 2)]
    )

    assert found is None or set(found.view) == {1}


# --- views ----------------------------------------------------------------------------------------


def sideways(step: float, index: int) -> Sim3:
    return Sim3(np.eye(3), np.array([step * index, 0.0, 0.0]))


def test_a_picture_is_a_view_only_after_motion() -> None:
    views = LensViews(GUESS)
    for index in range(10):
        views.offer(index, Sim3.identity(), 0, 1.0, lambda: NOTHING)

    assert len(views.posed_views({index: Sim3.identity() for index in range(10)})) == 1


def test_too_many_views_are_thinned_until_neighbours_no_longer_overlap() -> None:
    views, index = LensViews(GUESS), 0
    while not views.complete:
        views.offer(index, sideways(0.01, index), 0, 1.0, lambda: NOTHING)
        index += 1
        if views.full and not views.complete:
            views.thin()

    poses = {i: sideways(0.01, i) for i in range(index)}
    kept = views.posed_views(poses)
    assert len(kept) == MOST_VIEWS
    gap = kept[-1].T_wc.t[0] - kept[-2].T_wc.t[0]
    assert gap * GUESS.fx / GUESS.width == pytest.approx(LAST_SPACING, rel=0.1)


def test_views_are_of_the_sub_map_with_most_of_them() -> None:
    views = LensViews(GUESS)
    for index in range(9):
        views.offer(index, sideways(0.1, index), int(index >= 3), 1.0, lambda: NOTHING)

    assert len(views.posed_views({index: sideways(0.1, index) for index in range(9)})) == 6
    assert views.posed_views({}) == []


def test_motion_counts_turns_and_the_way_over_the_range() -> None:
    turned = Sim3(so3_exp(np.array([0.0, 0.2, 0.0])), np.array([0.3, 0.0, 0.0]))
    assert motion(Sim3.identity(), turned, rho=0.5) == pytest.approx(0.2 + 0.15)
