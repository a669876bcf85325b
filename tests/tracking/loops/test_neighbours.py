"""Keyframes of the same place: near, alike, not turned away, and none that was put aside."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import TrackingConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.tracking.loops import Neighbours
from tests.tracking.tracked_clips import SMALL, plane_depth
from tests.tracking.tracking_scenes import KnownView, pose

HERE = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def made(poses: list[Sim3]) -> tuple[Neighbours, list[Keyframe]]:
    store, neighbours = KeyframeStore(), Neighbours(TrackingConfig())
    for i, T in enumerate(poses):
        rho = 1.0 / plane_depth(T)
        view = KnownView(SMALL, T, plane_depth(T))
        keyframe = store.add(i, 0, view, T, Pointmap(SMALL, rho, (0.01 * rho) ** 2), 0)
        neighbours.add(keyframe)
    return neighbours, store.keyframes


def numbers(neighbours: Neighbours, besides: Keyframe) -> list[int]:
    return [each.keyframe.number for each in neighbours.around(HERE, SMALL, 0, besides)]


def test_the_most_alike_comes_first_and_what_is_out_of_view_not_at_all() -> None:
    near, nearer = pose((0, 0, 0), (0.25, 0.0, 0.0)), pose((0, 0, 0), (0.1, 0.0, 0.0))
    neighbours, keyframes = made([HERE, near, nearer, pose((0, 0, 0), (3.0, 0.0, 0.0))])
    assert numbers(neighbours, keyframes[0]) == [2, 1]


@pytest.mark.parametrize(("degrees", "found"), [(5.0, [2, 1]), (15.0, [1, 2]), (30.0, [1])])
def test_a_turned_picture_is_less_alike_and_too_far_turned_it_is_left_out(
    degrees: float, found: list[int]
) -> None:
    beside = pose((0, 0, 0), (0.25, 0.0, 0.0))
    turned = pose((0, 0, np.radians(degrees)), (0.02, 0.0, 0.0))
    neighbours, keyframes = made([HERE, beside, turned])
    assert numbers(neighbours, keyframes[0]) == found


def test_a_keyframe_put_aside_does_not_come_back() -> None:
    neighbours, keyframes = made([HERE, pose((0, 0, 0), (0.1, 0.0, 0.0))])
    neighbours.set_aside(keyframes[1])
    neighbours.add(keyframes[1])
    assert numbers(neighbours, keyframes[0]) == []
    assert neighbours.points(keyframes[1]) is None


def test_its_points_stay_those_of_when_it_was_first_left() -> None:
    neighbours, keyframes = made([HERE])
    before = neighbours.points(keyframes[0])
    assert before is not None
    keyframes[0].pointmap.rho /= 1.2
    neighbours.add(keyframes[0])
    assert neighbours.points(keyframes[0]) is before
