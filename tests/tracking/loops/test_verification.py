"""Verification: a place found again has the right pose; chance, fish and other places have none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from aquaflow.config import VerificationConfig
from aquaflow.geometry.similarity import Sim3, so3_log
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.contract import Keypoints
from aquaflow.prior.flow_pair import FlowEncoding
from aquaflow.tracking.loops import match_keypoints, verify
from tests.tracking.tracking_scenes import CAMERA, SeaFloor, pose

FLOOR = SeaFloor()
PRIOR = ClassicalPrior()
HERE = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
CONFIG = VerificationConfig()


def seen(T_wc: Sim3, floor: SeaFloor = FLOOR) -> FlowEncoding:
    return PRIOR.encode(floor.picture(T_wc), CAMERA)


def pointmap(T_wc: Sim3, unit: float = 1.0, sigma: float = 0.01) -> Pointmap:
    """The floor's true depths, in units of which one metre has ``unit``."""
    rho = 1.0 / (unit * FLOOR.depth(T_wc))
    return Pointmap(CAMERA, rho, (sigma * rho) ** 2)


def keyframe(T_wc: Sim3 = HERE, sigma: float = 0.01) -> Keyframe:
    return KeyframeStore().add(0, 0, seen(T_wc), T_wc, pointmap(T_wc, sigma=sigma), 0)


@pytest.mark.parametrize(
    "there",
    [
        pose((0.02, -0.03, 0.0), (0.1, 0.05, 0.0)),
        pose((0.0, 0.0, 0.1), (0.3, -0.1, -0.1)),
        pose((0.05, 0.0, np.pi / 2.0), (0.15, 0.1, 0.0)),
        pose((0.0, 0.04, np.pi - 0.01), (-0.1, 0.1, 0.05)),
    ],
    ids=["near", "far", "quarter turn", "reverse heading"],
)
def test_a_place_seen_again_gets_its_pose_whatever_the_heading(there: Sim3) -> None:
    found = verify(keyframe(), seen(there), CAMERA, CONFIG)
    assert found is not None
    error = found.estimate.T @ HERE.inverse() @ there
    assert np.linalg.norm(error.t) < 0.02
    assert np.linalg.norm(so3_log(error.R)) < 0.01
    assert found.estimate.T.scale == 1.0
    assert found.inliers > 3 * CONFIG.min_inliers
    assert found.cells >= CONFIG.min_cells


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_another_place_is_no_place(seed: int) -> None:
    other = seen(pose((0.0, 0.0, 0.0), (0.1 * seed, 0.0, 0.0)), SeaFloor(seed))
    assert len(match_keypoints(keyframe().encoding.keypoints, other.keypoints)[0]) < 20
    assert verify(keyframe(), other, CAMERA, CONFIG) is None


def test_a_black_picture_is_no_place() -> None:
    black = PRIOR.encode(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), CAMERA)
    assert verify(keyframe(), black, CAMERA, CONFIG) is None


def test_a_fish_seen_in_two_places_makes_them_no_one_place() -> None:
    """Many keypoints agree, but all of them in one corner of the picture."""
    fish = cv2.resize(SeaFloor(9).picture(HERE), (100, 75), interpolation=cv2.INTER_AREA)
    pictures = [SeaFloor(seed).picture(HERE) for seed in (0, 1)]
    for picture in pictures:
        picture[20:95, 30:130] = fish
    first, second = (PRIOR.encode(picture, CAMERA) for picture in pictures)
    there = KeyframeStore().add(0, 0, first, HERE, pointmap(HERE), 0)
    loose = CONFIG.model_copy(update={"min_cells": 1})
    assert verify(there, second, CAMERA, loose) is not None
    wide = CONFIG.model_copy(update={"min_cells": 17})
    assert verify(there, second, CAMERA, wide) is None


def test_a_keyframe_without_depth_proves_nothing() -> None:
    assert verify(keyframe(sigma=0.5), seen(HERE), CAMERA, CONFIG) is None


def test_too_few_or_too_contradicting_keypoints_prove_nothing() -> None:
    there = seen(pose((0.0, 0.0, 0.0), (0.2, 0.0, 0.0)))
    assert verify(keyframe(), there, CAMERA, CONFIG) is not None
    many = CONFIG.model_copy(update={"min_inliers": 5000})
    assert verify(keyframe(), there, CAMERA, many) is None
    strict = CONFIG.model_copy(update={"inlier_px": 0.05})
    assert verify(keyframe(), there, CAMERA, strict) is None


@pytest.mark.parametrize("unit", [1.0, 0.7, 1.6])
def test_two_pointmaps_of_different_units_are_joined_by_a_similarity(unit: float) -> None:
    there = pose((0.0, 0.02, 0.1), (0.2, 0.1, 0.0))
    found = verify(keyframe(), seen(there), CAMERA, CONFIG, pointmap(there, unit))
    assert found is not None
    T = found.estimate.T
    assert T.scale == pytest.approx(unit, rel=0.01)
    assert np.linalg.norm(T.t - unit * there.inverse().t) < 0.03
    assert found.estimate.covariance.shape == (7, 7)


def test_a_pointmap_whose_scale_stays_unknown_is_not_joined() -> None:
    there = pose((0.0, 0.02, 0.1), (0.2, 0.1, 0.0))
    empty = Pointmap.unknown(CAMERA)
    assert verify(keyframe(), seen(there), CAMERA, CONFIG, empty) is None
    strict = CONFIG.model_copy(update={"max_scale_sigma": 1e-6})
    assert verify(keyframe(), seen(there), CAMERA, strict, pointmap(there)) is None


def test_only_clear_and_mutual_neighbours_match() -> None:
    rng = np.random.default_rng(0)
    A = rng.random((6, 16)).astype(np.float32)
    # Of b: 0 and 1 are copies, 2 has a twin, 3 is matched by two of a, the last is a stranger.
    B = np.vstack([A[0], A[1], A[2], A[2] * 1.0001, A[3], rng.random((1, 16))]).astype(np.float32)
    A[4] = A[3] + 0.02 * rng.random(16).astype(np.float32)
    pixels = np.zeros((6, 2), np.float32)
    mine, theirs = match_keypoints(Keypoints(pixels, A), Keypoints(pixels, B))
    assert list(zip(mine, theirs, strict=True)) == [(0, 0), (1, 1), (3, 4)]


def test_pictures_without_keypoints_match_nowhere() -> None:
    none = Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 16), np.float32))
    one = Keypoints(np.zeros((1, 2), np.float32), np.ones((1, 16), np.float32))
    for a, b in ((none, one), (one, none), (one, one)):
        assert len(match_keypoints(a, b)[0]) == 0
