"""Learned depths fill pointmaps, keep out of the poses of others, and give way to triangulation."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import TrackingConfig
from aquaflow.config.tracking import LearnedConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.tracking.learned.fusion import add_learned, fuse_learned
from aquaflow.tracking.learned.scaling import LearnedDepth
from aquaflow.tracking.pose.depth_fusion import fuse, transfer
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


def test_what_was_not_triangulated_gets_the_learned_depth() -> None:
    pointmap = filled()
    assert pointmap.learned is not None
    assert pointmap.learned[:, HALF:].all()
    assert not pointmap.learned[:, :HALF].any()
    np.testing.assert_array_equal(pointmap.rho[:, :HALF], 1.0 / TRUTH[:, :HALF])
    error = np.abs(np.log(pointmap.rho * TRUTH))[:, HALF:]
    assert np.median(error) < 0.08
    assert pointmap.known_or_learned(KNOWN_SIGMA).mean() > 0.9
    assert not pointmap.known(KNOWN_SIGMA)[:, HALF:].any()


def test_of_a_bad_triangulation_the_learned_depth_takes_the_place() -> None:
    pointmap = filled(sigma=0.01)
    worse = measured(share=1.0, sigma=0.12)
    fuse_learned(worse, LearnedDepth(1.0 / TRUTH, np.full(TRUTH.shape, 0.05**2), 0.0, 0.0, 1.0))
    assert worse.learned is not None
    assert worse.learned.all()
    assert pointmap.learned is not None
    assert not pointmap.learned[:, :HALF].any()


@pytest.mark.parametrize("config", [LearnedConfig(depth=False), LearnedConfig()])
def test_nothing_changes_without_ranges_or_where_they_are_not_wanted(config: LearnedConfig) -> None:
    pointmap, X, Q = measured(), *network()
    given = (None, None) if config.depth else (X, Q)
    assert add_learned(pointmap, *given, KNOWN_SIGMA, config) is None
    assert pointmap.learned is None
    np.testing.assert_array_equal(pointmap.rho, measured().rho)


def test_triangulation_replaces_a_learned_depth_and_takes_no_mean() -> None:
    pointmap = filled()
    fuse(pointmap, pair(), MOVED, CAMERA, 0.2)
    assert pointmap.learned is not None
    now = ~pointmap.learned
    now[:, :HALF] = False
    assert now.sum() > 0.5 * HALF * CAMERA.height
    assert np.median(np.abs(np.log(pointmap.rho * TRUTH))[now]) < 0.02


def test_a_learned_depth_stays_where_triangulation_is_worse() -> None:
    """Of a step of a thousandth of the depth."""
    short = pose((0.0, 0.0, 0.0), (0.0015, 0.0, 0.0))
    pointmap = filled()
    fuse(pointmap, pair(short), short, CAMERA, 0.2)
    assert pointmap.learned is not None
    assert pointmap.learned[:, HALF:].mean() > 0.95


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
    pointmap.learned = pointmap.rho > 0.0
    found = matched(pointmap, pair())
    assert found is not None
    assert np.linalg.norm(found.estimate.T.t - MOVED.t) < 0.02 * np.linalg.norm(MOVED.t) + 0.01


def matched(pointmap: Pointmap, seen: KnownPair):  # type: ignore[no-untyped-def]
    start = Sim3.identity()
    return KeyframeMatcher(TrackingConfig()).pose(keyframe(pointmap), CAMERA, seen, start, start)


def test_the_next_keyframe_knows_which_depths_were_learned() -> None:
    pointmap, seen = filled(), pair()
    moved = transfer(pointmap, seen.matches_back, seen.valid_back, MOVED, CAMERA)
    assert moved.learned is not None
    assert moved.learned.any()
    assert (~moved.learned & (moved.rho > 0.0)).any()
    plain = transfer(measured(), seen.matches_back, seen.valid_back, MOVED, CAMERA)
    assert plain.learned is None
    both = (plain.rho > 0.0) & ~moved.learned
    np.testing.assert_allclose(moved.rho[both], plain.rho[both])


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
    np.testing.assert_array_equal(found.learned, kept.learned)
    np.testing.assert_array_equal(found.rho, kept.rho)
