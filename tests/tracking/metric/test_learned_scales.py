"""A network's unit holds the map's: drift beyond its error is taken out, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore, LearnedDepths, Pointmap
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph
from aquaflow.tracking.metric.straightening import (
    EVERY,
    LEAST_KEYFRAMES,
    LearnedScales,
    worlds_of,
)
from tests.tracking.tracking_scenes import CAMERA, KnownView

COUNT = 120
LINK = np.diag(np.array([0.01, 0.01, 0.01, 0.002, 0.002, 0.002, 0.005]) ** -2.0)


def drifted(rate: float) -> PoseGraph:
    """Keyframes half a unit apart, whose scale grows by ``rate`` at every link."""
    graph, T = PoseGraph(), Sim3.identity()
    graph.add_keyframe(0, T)
    for k in range(1, COUNT):
        link = Sim3(np.eye(3), np.array([0.5, 0.05 * np.sin(0.3 * k), 0.0]), 1.0 + rate)
        T = T @ link
        graph.add_keyframe(k, T)
        assert graph.add_edge(Edge(k - 1, k, link, LINK))
    return graph


def stated(sigma: float, unit: float = 7.0, seed: int = 0) -> dict[int, tuple[float, float]]:
    """What a network says whose error of each picture's scale is ``sigma``: its pictures are all of
    the same size, whatever scale the map gave them."""
    rng = np.random.default_rng(seed)
    return {k: (float(np.log(unit) + sigma * rng.normal()), 0.01) for k in range(COUNT)}


def scales(graph: PoseGraph) -> np.ndarray:
    return np.array([graph.pose(k).scale for k in range(COUNT)])


def solved(graph: PoseGraph, known: dict[int, tuple[float, float]]) -> bool:
    """True if the scales took part."""
    store = KeyframeStore()
    learned = LearnedScales(store, 0.0)
    learned._known = known
    snapshot = graph.snapshot()
    graph.apply(learned.job(snapshot)(snapshot))
    return bool(worlds_of(snapshot, known))


@pytest.mark.parametrize("rate", [0.006, -0.006])
@pytest.mark.parametrize("unit", [0.02, 7.0])
def test_a_drift_of_scale_stays_bounded(rate: float, unit: float) -> None:
    """By the drift of as many links as it takes for their own sigma to reach the network's: 20."""
    graph = drifted(rate)
    before = scales(graph)
    assert solved(graph, stated(0.1, unit))
    after = scales(graph)
    drift = [abs(np.log(found[-10:].mean() / found[:10].mean())) for found in (before, after)]
    assert drift[0] > 0.6
    assert drift[1] < 0.3 * drift[0]


def test_the_first_keyframe_stays() -> None:
    graph = drifted(0.006)
    solved(graph, stated(0.1))
    np.testing.assert_allclose(graph.pose(0).t, 0.0, atol=0.02)
    np.testing.assert_allclose(graph.pose(0).R, np.eye(3), atol=0.02)


@pytest.mark.parametrize("sigma", [0.05, 0.2])
def test_a_network_that_errs_by_more_than_the_drift_moves_nothing(sigma: float) -> None:
    graph = drifted(0.0)
    before = scales(graph)
    assert not solved(graph, stated(sigma))
    np.testing.assert_array_equal(scales(graph), before)


def test_components_that_never_met_are_looked_at_one_by_one() -> None:
    graph = drifted(0.006)
    for k in range(COUNT, COUNT + LEAST_KEYFRAMES - 1):
        graph.add_keyframe(k, Sim3.identity())
    known = stated(0.1) | dict.fromkeys(range(COUNT, COUNT + LEAST_KEYFRAMES - 1), (9.0, 0.01))
    assert [world.component for world in worlds_of(graph.snapshot(), known)] == [0]


def test_it_is_asked_for_every_few_keyframes_once_there_are_enough() -> None:
    store = KeyframeStore()
    learned, due = LearnedScales(store, 0.0), []
    for k in range(LEAST_KEYFRAMES + EVERY + 1):
        pointmap = Pointmap.unknown(CAMERA)
        nothing = np.zeros((CAMERA.height, CAMERA.width))
        pointmap.learned = LearnedDepths(nothing, nothing, 0.1, 0.02) if k else None
        view = KnownView(CAMERA, Sim3.identity(), np.ones((CAMERA.height, CAMERA.width)))
        store.add(k, 0, view, Sim3.identity(), pointmap, 0)
        due.append(learned.keyframe(k, None))
    assert learned.present
    assert [k for k, each in enumerate(due) if each] == [LEAST_KEYFRAMES, LEAST_KEYFRAMES + EVERY]


def test_keyframes_of_a_prior_without_ranges_have_no_scale() -> None:
    store = KeyframeStore()
    learned = LearnedScales(store, 0.0)
    for k in range(2 * LEAST_KEYFRAMES):
        view = KnownView(CAMERA, Sim3.identity(), np.ones((CAMERA.height, CAMERA.width)))
        store.add(k, 0, view, Sim3.identity(), Pointmap.unknown(CAMERA), 0)
        assert not learned.keyframe(k, None)
    assert not learned.present
