"""What a frame should show of a keyframe, and what of it was seen."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.pose.matcher import agreeing, is_expected, predicted_matches, visibility
from tests.tracking.tracking_scenes import CAMERA, pose

DEPTH = 2.0
SHAPE = (CAMERA.height, CAMERA.width)
ALL = np.ones(SHAPE, bool)
ASIDE = Sim3(np.eye(3), np.array([-0.25 * CAMERA.width * DEPTH / CAMERA.fx, 0.0, 0.0]))
"""The scene moves a quarter of the picture to the left."""


def wall() -> Pointmap:
    rho = np.full(SHAPE, 1.0 / DEPTH)
    return Pointmap(CAMERA, rho, (0.01 * rho) ** 2)


def seen_from(T: Sim3) -> np.ndarray:
    """[H, W, 2] px of the wall's points in a picture at ``T``."""
    nothing = np.zeros((*SHAPE, 2), np.float32)
    return predicted_matches(wall(), ALL, T, CAMERA, nothing)


@pytest.mark.parametrize(
    ("T", "overlap"),
    [
        (Sim3.identity(), 1.0),
        (ASIDE, 0.75),
        (Sim3(np.eye(3), np.zeros(3), 7.0), 1.0),
        (pose((0.0, np.pi, 0.0), (0.0, 0.0, 0.0)), 0.0),
        (pose((0.0, 0.0, 0.0), (0.0, 0.0, 1.5 * DEPTH)), 0.0),
        (pose((0.0, 1.0, 0.0), (-1.68, 0.0, 0.92)), 0.0),
    ],
    ids=["same place", "a quarter aside", "another unit", "behind", "far back", "round 57 degrees"],
)
def test_overlap_is_what_shows_alike(T: Sim3, overlap: float) -> None:
    found = visibility(wall(), ALL, seen_from(T), ALL, T, CAMERA)
    assert found.overlap == pytest.approx(overlap, abs=0.01)


def test_what_is_out_of_view_is_not_missed_and_what_is_hidden_is() -> None:
    matched = ALL.copy()
    matched[:, : CAMERA.width // 4] = False  # these go out of view
    assert visibility(wall(), ALL, seen_from(ASIDE), matched, ASIDE, CAMERA).seen == 1.0
    matched[::2] = False
    left = visibility(wall(), ALL, seen_from(ASIDE), matched, ASIDE, CAMERA).seen
    assert left == pytest.approx(0.5, abs=0.02)


def test_what_is_matched_elsewhere_than_the_pose_says_is_not_seen() -> None:
    astray = seen_from(ASIDE)
    astray[::2] += 5.0
    seen = visibility(wall(), ALL, astray, ALL, ASIDE, CAMERA).seen
    assert seen == pytest.approx(0.5, abs=0.02)


def test_of_a_keyframe_that_is_not_there_nothing_is_hidden() -> None:
    nothing = visibility(wall(), ~ALL, seen_from(ASIDE), ALL, ASIDE, CAMERA)
    assert (nothing.overlap, nothing.seen) == (0.0, 1.0)
    away = Sim3(np.eye(3), np.array([100.0, 0.0, 0.0]))
    assert visibility(wall(), ALL, seen_from(away), ~ALL, away, CAMERA).seen == 1.0


@pytest.mark.filterwarnings("error")
def test_points_in_the_camera_centre_or_that_are_no_numbers_are_not_expected() -> None:
    points = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert is_expected(points, Sim3.identity(), CAMERA).tolist() == [False, False, True]


def test_matches_are_predicted_where_depth_is_known_and_only_there() -> None:
    known = ALL.copy()
    known[:10] = False
    otherwise = np.zeros((*SHAPE, 2), np.float32)
    found = predicted_matches(wall(), known, ASIDE, CAMERA, otherwise)
    assert (found[:10] == 0.0).all()
    column = np.arange(CAMERA.width) + 0.5
    np.testing.assert_allclose(found[20, :, 0], column - 0.25 * CAMERA.width, atol=1e-3)


def test_a_pixel_whose_match_the_pose_puts_elsewhere_does_not_agree() -> None:
    back = CAMERA.pixel_centres().astype(np.float32)
    back[..., 0] += 0.25 * CAMERA.width
    valid = back[..., 0] < CAMERA.width
    back[50:60, :, 1] += 20.0
    found = agreeing(wall(), back, valid, ASIDE, CAMERA)
    assert not found[50:60].any()
    assert (found[:50] == valid[:50]).all()
    unknown = Pointmap.unknown(CAMERA)
    assert not agreeing(unknown, back, valid, ASIDE, CAMERA).any()
