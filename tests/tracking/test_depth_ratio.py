"""Depths of two pointmaps compared: a scale is found as it is, and nothing is made of nothing."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.consistency import depth_ratio
from tests.tracking.tracked_clips import SMALL, plane_depth
from tests.tracking.tracking_scenes import pose

HERE = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
THERE = pose((0.02, 0.1, 0.2), (0.1, -0.05, 0.02))


def seen(T_wc: Sim3, unit: float = 1.0) -> Pointmap:
    rho = 1.0 / (unit * plane_depth(T_wc))
    return Pointmap(SMALL, rho, (0.01 * rho) ** 2)


def points_of(pointmap: Pointmap) -> np.ndarray:
    return pointmap.points()[::6, ::6].reshape(-1, 3)


@pytest.mark.parametrize("unit", [1.0, 1.2, 0.5])
def test_the_ratio_is_that_of_the_two_units(unit: float) -> None:
    points = points_of(seen(HERE))
    found = depth_ratio(points, THERE.inverse() @ HERE, seen(THERE, unit), 0.15)
    assert found is not None
    # Where the wrong depth lies, the plane is a little nearer or further.
    assert found.log == pytest.approx(np.log(unit), abs=0.01)
    assert found.sigma < 0.01
    assert 50 < found.points <= len(points)


def test_noise_of_the_points_is_in_its_sigma() -> None:
    rng, pointmap = np.random.default_rng(0), seen(HERE)
    off = []
    for _ in range(50):
        points = points_of(pointmap)
        noisy = points * (1.0 + 0.1 * rng.standard_normal((len(points), 1)))
        found = depth_ratio(noisy, Sim3.identity(), pointmap, 0.15)
        assert found is not None
        off.append(found.log / found.sigma)
    assert 0.5 < np.std(off) < 1.7


def test_a_view_of_something_else_says_nothing() -> None:
    away = pose((0.0, 0.0, 0.0), (10.0, 0.0, 0.0))
    assert depth_ratio(points_of(seen(HERE)), away, seen(HERE), 0.15) is None


def test_depths_that_are_not_known_say_nothing() -> None:
    pointmap = seen(HERE)
    pointmap.variance[:] = 1e6
    assert depth_ratio(points_of(seen(HERE)), Sim3.identity(), pointmap, 0.15) is None
