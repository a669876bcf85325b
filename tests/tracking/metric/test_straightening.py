"""The keyframe graph with a world: scale drift is pulled straight, loops are judged as before."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes import Keyframe, KeyframeStore
from aquaflow.tracking.consistency import scale_drift
from aquaflow.tracking.graph.equations import poses_of
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph
from aquaflow.tracking.graph.table import GraphResult
from aquaflow.tracking.metric.measured import KeyframeMeasurements, World, WorldEdge, world_edge
from aquaflow.tracking.metric.straightening import STRAIN, TREND_SIGMAS, solve_with_worlds
from tests.tracking.graph.graph_scenes import LOOP_SIGMA, Dive

Array = npt.NDArray[np.float64]

COUNT = 60
DRIFT = 0.05
"""Relative, from the first keyframe to the last."""
LINK = np.diag(np.array([0.01, 0.01, 0.01, 0.002, 0.002, 0.002, 0.003]) ** -2.0)


def way() -> Sim3Batch:
    """Keyframes on a way that rises and sinks, 0.5 m apart; the map is n, turned by nothing."""
    k = np.arange(COUNT)
    t = np.column_stack([0.5 * k, 0.3 * np.sin(0.2 * k), 1.5 * np.sin(0.3 * k)])
    return Sim3Batch(np.tile(np.eye(3), (COUNT, 1, 1)), t, np.ones(COUNT))


def drifted(truth: Sim3Batch) -> PoseGraph:
    """Links of which each is a little too large: scale and all that follows grow by DRIFT."""
    graph = PoseGraph()
    grown = Sim3.exp(np.array([0, 0, 0, 0, 0, 0, np.log1p(DRIFT) / (COUNT - 1)]))
    T = truth.element(0)
    graph.add_keyframe(0, T)
    for k in range(1, COUNT):
        link = truth.element(k - 1).inverse() @ truth.element(k) @ grown
        T = T @ link
        graph.add_keyframe(k, T)
        assert graph.add_edge(Edge(k - 1, k, link, LINK))
    return graph


def world(graph: PoseGraph, truth: Sim3Batch, kind: str) -> World:
    """What exact instruments say of every keyframe."""
    edges: list[WorldEdge] = []
    for k in range(COUNT):
        T, true = graph.pose(k), truth.element(k)
        measured = {
            "depth": KeyframeMeasurements(depth_m=(float(true.t[2]), 0.01), turn=np.zeros(3),
                              turn_sigma=(0.002, 0.01),
                              place_m=(true.t[:2], 1e-3) if k == 0 else None),
            "scale": KeyframeMeasurements(scale=(true.scale, 0.005),
                              turn=np.zeros(3), turn_sigma=(0.002, 0.01),
                              place_m=(true.t[:2], 1e-3) if k == 0 else None,
                              depth_m=(float(true.t[2]), 1e-3) if k == 0 else None),
        }[kind]  # fmt: skip
        edge = world_edge(k, T, measured)
        assert edge is not None
        edges.append(edge)
    return World(0, Sim3.identity(), edges)


def local_scales(t: Array, truth: Array) -> Array:
    """Length of each step over the true one."""
    return np.asarray(
        np.linalg.norm(np.diff(t, axis=0), axis=1) / np.linalg.norm(np.diff(truth, axis=0), axis=1)
    )


def solved(graph: PoseGraph, worlds: list[World]) -> tuple[GraphResult, Sim3Batch]:
    result, _ = solve_with_worlds(graph.snapshot(), worlds)
    graph.apply(result)
    return result, poses_of(graph.snapshot().nodes)


@pytest.mark.parametrize(("kind", "left"), [("depth", 0.5), ("scale", 0.2)])
def test_scale_drift_of_five_percent_is_pulled_straight(kind: str, left: float) -> None:
    truth = way()
    graph = drifted(truth)
    before = local_scales(poses_of(graph.snapshot().nodes).t, truth.t)
    assert before[-1] == pytest.approx(1.0 + DRIFT, rel=0.01)
    _, poses = solved(graph, [world(graph, truth, kind)])
    after = local_scales(poses.t, truth.t)
    # What counts is drift: the unit of the whole is the world's to say.
    assert np.ptp(after) < left * DRIFT
    np.testing.assert_allclose(poses.scale / poses.scale[0], 1.0, atol=left * DRIFT)


def keyframe_of(number: int, frame: int) -> Keyframe:
    return Keyframe(number, frame, 0, Sim3.identity(), 0, KeyframeStore())


def test_a_drift_that_telemetry_showed_is_told_with_its_frames() -> None:
    truth, graph, edges = way(), PoseGraph(), list[WorldEdge]()
    grown = np.exp(np.linspace(0.0, np.log1p(DRIFT), COUNT))
    for k in range(COUNT):
        if k == 0:
            graph.add_keyframe(0, truth.element(0))
        else:  # the depths that it was tracked by are too large, and so is the step
            step = truth.element(k - 1).inverse() @ truth.element(k)
            link = Sim3(step.R, grown[k - 1] * step.t)
            graph.add_keyframe(k, graph.pose(k - 1) @ link)
            assert graph.add_edge(Edge(k - 1, k, link, LINK))
        measured = KeyframeMeasurements(
            scale=(1.0 / grown[k], 0.025), place_m=(truth.t[k, :2], 1e-3) if k == 0 else None
        )
        edge = world_edge(k, graph.pose(k), measured)
        assert edge is not None
        edges.append(edge)
    keyframes = [keyframe_of(k, 10 * k) for k in range(COUNT)]
    unseen = scale_drift(graph.snapshot(), keyframes)
    assert unseen is not None
    assert unseen.ratio == 1.0
    assert unseen.notes() == []
    telemetry = World(0, Sim3.identity(), edges)
    assert telemetry.strain < STRAIN
    assert telemetry.scale_trend_sigmas > TREND_SIGMAS
    solved(graph, [telemetry])
    found = scale_drift(graph.snapshot(), keyframes)
    assert found is not None
    assert 0.6 * DRIFT < found.ratio - 1.0 < 1.2 * DRIFT
    assert found.first < 10 * (COUNT // 4) < 10 * (3 * COUNT // 4) < found.last
    [note] = found.notes()
    assert f"between frames {found.first} and {found.last}" in note


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_the_measured_scale_is_no_trend(seed: int) -> None:
    noise = 0.03 * np.random.default_rng(seed).standard_normal(COUNT)
    measured = [KeyframeMeasurements(scale=(float(np.exp(each)), 0.03)) for each in noise]
    edges = [world_edge(k, Sim3.identity(), each) for k, each in enumerate(measured)]
    assert World(0, Sim3.identity(), [e for e in edges if e]).scale_trend_sigmas < TREND_SIGMAS


def test_the_place_of_a_joined_sub_map_is_no_drift() -> None:
    graph = PoseGraph()
    keyframes = []
    for k in range(6):
        scale = 1.0 if k < 3 else 2.0
        graph.add_keyframe(k, Sim3(np.eye(3), np.array([0.5 * k, 0.0, 0.0]), scale))
        keyframes.append(keyframe_of(k, k))
        if k % 3:
            link = graph.pose(k).inverse() @ graph.pose(k - 1)
            assert graph.add_edge(Edge(k, k - 1, link, LINK))
    found = scale_drift(graph.snapshot(), keyframes)
    assert found is not None
    assert found.ratio == pytest.approx(1.0)


def test_a_drift_is_told_whatever_the_order_in_which_its_links_were_found() -> None:
    graph = PoseGraph()
    for k in range(4):
        graph.add_keyframe(k, Sim3(np.eye(3), np.array([0.5 * k, 0.0, 0.0]), 1.0 - 0.1 * k))
    for k in (3, 2, 1):
        assert graph.add_edge(Edge(k - 1, k, graph.pose(k - 1).inverse() @ graph.pose(k), LINK))
    found = scale_drift(graph.snapshot(), [keyframe_of(k, k) for k in range(4)])
    assert found is not None
    assert (found.first, found.last) == (0, 3)
    assert found.ratio == pytest.approx(1.0 / 0.7)


def test_without_a_world_nothing_of_the_graph_changes() -> None:
    graph = drifted(way())
    before = poses_of(graph.snapshot().nodes)
    result, T_mn = solve_with_worlds(graph.snapshot(), [])
    assert not result.poses
    assert not T_mn
    graph.apply(result)
    np.testing.assert_array_equal(poses_of(graph.snapshot().nodes).t, before.t)


def test_the_result_holds_keyframes_only_and_the_world_by_its_component() -> None:
    truth = way()
    graph = drifted(truth)
    snapshot = graph.snapshot()
    result, T_mn = solve_with_worlds(snapshot, [world(graph, truth, "depth")])
    assert set(result.poses) <= set(range(COUNT))
    assert set(T_mn) == {0}
    assert len(result.edge_trust) == len(snapshot.edges)
    assert (result.rows < len(snapshot.nodes)).all()
    assert result.snapshot is snapshot
    # In the world, keyframes are where instruments have them.
    at = T_mn[0].inverse() @ result.poses.get(COUNT - 1, graph.pose(COUNT - 1))
    assert at.t[2] == pytest.approx(truth.t[-1, 2], abs=0.05)


def looped(false: bool) -> tuple[Dive, list[World]]:
    """A circle of which telemetry says exactly where every keyframe is; and a loop."""
    dive = Dive(count=40, seed=2)
    (dive.plant if false else dive.close)((3, 30) if false else (0, 39))
    edges = []
    for k in range(dive.count):
        true = dive.truth.element(k)
        measured = KeyframeMeasurements(
            depth_m=(float(true.t[2]), 0.01), place_m=(true.t[:2], 0.01), turn=np.zeros(3),
            turn_sigma=(0.1, 0.1),
        )  # fmt: skip
        edge = world_edge(k, dive.graph.pose(k), measured)
        assert edge is not None
        edges.append(edge)
    return dive, [World(0, Sim3.identity(), edges)]


@pytest.mark.parametrize("false", [True, False])
def test_loops_are_judged_by_the_links_and_not_through_the_world(false: bool) -> None:
    dive, worlds = looped(false)
    loop = int(np.flatnonzero(dive.graph.snapshot().edges["loop"])[0])
    for chosen in ([], worlds):
        result, _ = solve_with_worlds(dive.graph.snapshot(), chosen)
        assert (result.trust[loop] == 0.0) == false


def test_a_chain_through_the_world_admits_no_loop_that_the_links_contradict() -> None:
    """Two keyframes far apart by links, whom a wrong world puts in one place."""
    dive = Dive(count=40, seed=2)
    near = dive.graph.pose(3)
    dive.graph.add_edge(Edge(3, 30, Sim3.identity(), np.diag(LOOP_SIGMA**-2), loop=True))
    edges = []
    for k in (3, 30):
        measured = KeyframeMeasurements(
            depth_m=(float(near.t[2]), 1e-3), place_m=(near.t[:2], 1e-3)
        )
        edge = world_edge(k, dive.graph.pose(k), measured)
        assert edge is not None
        edges.append(edge)
    result, _ = solve_with_worlds(dive.graph.snapshot(), [World(0, Sim3.identity(), edges)])
    loop = int(np.flatnonzero(dive.graph.snapshot().edges["loop"])[0])
    assert result.trust[loop] == 0.0


def test_loops_that_alone_hold_a_part_of_the_dive_are_strained_by_a_world_but_not_cut() -> None:
    """The second half is joined to the first by loops in one place alone, and its compass is off by
    more than they allow: cut, it would be free to go anywhere."""
    truth, half = way(), COUNT // 2
    graph = PoseGraph()
    for k in range(COUNT):
        graph.add_keyframe(k, truth.element(k))
    for k in [*range(1, half), *range(half + 1, COUNT)]:
        link = truth.element(k - 1).inverse() @ truth.element(k)
        assert graph.add_edge(Edge(k - 1, k, link, LINK))
    tie = np.diag(np.array([0.002, 0.002, 0.002, 0.001, 0.001, 0.001, 0.002]) ** -2.0)
    pairs = [(half - 1 - i, half + i) for i in range(3)]
    for a, b in pairs:
        T_ab = truth.element(a).inverse() @ truth.element(b)
        assert graph.add_edge(Edge(a, b, T_ab, tie, loop=True))
    edges = []
    for k in range(COUNT):
        off = np.array([0.0, 0.0, 0.0 if k < half else 0.3])
        measured = KeyframeMeasurements(
            depth_m=(float(truth.t[k, 2]), 0.01), turn=off, turn_sigma=(0.001, 0.001),
            place_m=(truth.t[k, :2], 1e-3) if k == 0 else None,
        )  # fmt: skip
        edge = world_edge(k, graph.pose(k), measured)
        assert edge is not None
        edges.append(edge)
    result, poses = solved(graph, [World(0, Sim3.identity(), edges)])
    assert all(trust > 0.0 for trust in result.trust.values())
    for a, b in pairs:
        apart = poses.element(a).inverse() @ poses.element(b)
        wanted = truth.element(a).inverse() @ truth.element(b)
        assert np.linalg.norm(apart.t - wanted.t) < 0.3
    allowed = graph.snapshot().trust["allowed"]
    assert (allowed == graph.config.loop_chi2).all(), "they are judged as others from here on"
