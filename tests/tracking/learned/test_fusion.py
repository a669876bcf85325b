"""Learned depths fill pointmaps, keep out of the poses of others, and give way to triangulation."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import TrackingConfig
from aquaflow.config.tracking import LearnedConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import UNKNOWN_VARIANCE, Keyframe, KeyframeStore, Pointmap
from aquaflow.tracking.learned import add_learned
from aquaflow.tracking.pose.depth_fusion import fuse
from aquaflow.tracking.pose.matcher import KeyframeMatcher
from tests.tracking.learned.learned_scenes import KNOWN_SIGMA, TRUTH, measured, network
from tests.tracking.tracking_scenes import CAMERA, KnownPair, KnownView, pose

HALF = CAMERA.width // 2
MOVED = pose((0.01, -0.02, 0.01), (0.15, 0.02, 0.01))


def filled(share: float = 0.5, sigma: float = 0.01) -> Pointmap:
    pointmap = measured(share, sigma)
    assert add_learned(pointmap, *network(), KNOWN_SIGMA, LearnedConfig()) is not None
    return pointmap


def pair(T_ba: Sim3 = MOVED) -> KnownPair:
    first = KnownView(CAMERA, Sim3.identity(), TRUTH)
    return KnownPair(first, KnownView(CAMERA, T_ba.inverse(), TRUTH), 0.05, CAMERA)


def keyframe(pointmap: Pointmap) -> Keyframe:
    view = KnownView(CAMERA, Sim3.identity(), TRUTH)
    return KeyframeStore().add(0, 0, view, Sim3.identity(), pointmap, 0)


def test_what_was_not_triangulated_is_completed_by_the_learned_depth() -> None:
    pointmap = filled()
    np.testing.assert_array_equal(pointmap.rho, measured().rho)
    whole = pointmap.complete(KNOWN_SIGMA)
    np.testing.assert_array_equal(whole.rho[:, :HALF], 1.0 / TRUTH[:, :HALF])
    error = np.abs(np.log(whole.rho * TRUTH))[:, HALF:]
    assert np.median(error) < 0.08
    assert whole.is_known(KNOWN_SIGMA).mean() > 0.9
    assert not pointmap.is_known(KNOWN_SIGMA)[:, HALF:].any()


def test_a_triangulation_that_is_not_good_enough_is_completed_and_not_lost() -> None:
    pointmap = filled(share=0.5)
    pointmap.variance[:, :HALF] = (0.3 * pointmap.rho[:, :HALF]) ** 2
    whole = pointmap.complete(KNOWN_SIGMA)
    assert pointmap.learned is not None
    np.testing.assert_array_equal(whole.rho, pointmap.learned.rho)
    np.testing.assert_array_equal(pointmap.rho[:, :HALF], 1.0 / TRUTH[:, :HALF])


@pytest.mark.parametrize("config", [LearnedConfig(depth=False), LearnedConfig()])
def test_nothing_changes_without_ranges_or_where_they_are_not_wanted(config: LearnedConfig) -> None:
    pointmap, X, Q = measured(), *network()
    given = (None, None) if config.depth else (X, Q)
    assert add_learned(pointmap, *given, KNOWN_SIGMA, config) is None
    assert pointmap.learned is None
    assert pointmap.complete(KNOWN_SIGMA) is pointmap


def test_triangulation_does_not_see_what_was_learned() -> None:
    pointmap, alone = filled(), measured()
    for each in (pointmap, alone):
        fuse(each, pair(), MOVED, CAMERA, 0.2)
    np.testing.assert_array_equal(pointmap.rho, alone.rho)
    np.testing.assert_array_equal(pointmap.variance, alone.variance)


def test_poses_are_solved_from_triangulated_depths_where_there_are_enough() -> None:
    seen = pair()
    alone, with_learned = measured(), filled()
    T = [
        found.estimate.T
        for pointmap in (alone, with_learned)
        if (found := matched(pointmap, seen)) is not None
    ]
    assert len(T) == 2
    np.testing.assert_array_equal(T[0].t, T[1].t)


def test_poses_are_solved_from_learned_depths_where_nothing_else_is_known() -> None:
    pointmap = filled()
    pointmap.rho[:], pointmap.variance[:] = 0.0, UNKNOWN_VARIANCE
    found = matched(pointmap, pair())
    assert found is not None
    assert np.linalg.norm(found.estimate.T.t - MOVED.t) < 0.02 * np.linalg.norm(MOVED.t) + 0.01


def matched(pointmap: Pointmap, seen: KnownPair):  # type: ignore[no-untyped-def]
    start = Sim3.identity()
    return KeyframeMatcher(TrackingConfig()).pose(keyframe(pointmap), CAMERA, seen, start, start)


def test_where_the_camera_only_turned_the_unit_is_that_of_what_was_learned_before() -> None:
    before, X, Q = filled(), *network(unit=5.0)
    now = Pointmap.unknown(CAMERA)
    assert add_learned(now, X, Q, KNOWN_SIGMA, LearnedConfig()) is None
    seen = before.complete(KNOWN_SIGMA)
    assert add_learned(now, X, Q, KNOWN_SIGMA, LearnedConfig(), before=lambda: seen) is not None
    assert now.learned is not None
    assert np.median(np.abs(np.log(now.learned.rho * TRUTH))) < 0.08


def test_a_pointmap_comes_back_from_its_file_with_what_was_learned(tmp_path) -> None:  # type: ignore[no-untyped-def]
    from aquaflow.prior.classical import ClassicalPrior

    prior = ClassicalPrior()
    store = KeyframeStore(tmp_path, prior, resident=1)
    picture = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    kept = filled()
    for number in range(4):
        encoding = prior.encode(picture, CAMERA)
        store.add(number, 0, encoding, Sim3.identity(), kept.copy(), 0)
    found = store[0].pointmap
    assert found.learned is not None
    assert kept.learned is not None
    np.testing.assert_allclose(found.learned.rho, kept.learned.rho, rtol=1e-6)
    np.testing.assert_allclose(found.learned.variance, kept.learned.variance, rtol=1e-6)
    assert found.learned.log_scale == kept.learned.log_scale
    np.testing.assert_array_equal(found.rho, kept.rho)
