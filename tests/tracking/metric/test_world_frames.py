"""Telemetry that cannot be used costs itself: neither the loops nor the frames known before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.config import FusionConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frame_table import FrameTable
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph
from aquaflow.tracking.graph.table import Snapshot
from aquaflow.tracking.metric import world_frames
from aquaflow.tracking.metric.measured import KeyframeMeasurements, World, world_edge
from aquaflow.tracking.metric.straightening import (
    Straightened,
    solve_with_worlds,
    straighten,
    straighten_again,
)
from aquaflow.tracking.metric.world_frames import FEW_KEYFRAMES, WorldFrames
from aquaflow.types import AngularRate, Depth
from tests.metric_scenes import metric_frame


def of_a_dive(failures: Failures) -> WorldFrames:
    frames = FrameTable()
    return WorldFrames(KeyframeStore(), lambda: frames, FusionConfig(), failures)


def looped() -> PoseGraph:
    graph = PoseGraph()
    for k in range(3):
        graph.add_keyframe(k, Sim3(np.eye(3), np.array([float(k), 0.0, 0.0])))
    step = Sim3(np.eye(3), np.array([0.9, 0.0, 0.0]))
    for k in range(2):
        assert graph.add_edge(Edge(k, k + 1, step, 1e4 * np.eye(7)))
    across = Sim3(np.eye(3), np.array([1.86, 0.0, 0.0]))
    assert graph.add_edge(Edge(0, 2, across, 1e4 * np.eye(7)))
    return graph


def test_a_failing_estimate_leaves_the_graph_its_own_optimisation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(*_: object) -> None:
        raise ArithmeticError("not finite")

    monkeypatch.setattr(world_frames, "straighten", fails)
    failures = Failures(strict=False)
    metric, graph = of_a_dive(failures), looped()
    metric.add(Depth(0, 0, "bar30", 3.0))
    snapshot = graph.snapshot()
    result = metric.job(snapshot)(snapshot)
    assert 1.83 < result.poses[2].t[0] < 1.86  # between the links and what goes across
    (kind,) = failures.to_json()
    assert kind["stage"] == "telemetry in the keyframe graph"
    metric.apply()
    assert metric.frames == {}


def test_a_sample_that_is_not_finite_is_refused_before_it_is_kept() -> None:
    metric = of_a_dive(Failures(strict=False))
    for sample in (
        Depth(0, 0, "bar30", float("nan")),
        AngularRate(0, 0, "gyro", (0.0, float("inf"), 0.0)),
    ):
        with pytest.raises(ArithmeticError, match=sample.source):
            metric.add(sample)
    assert not metric.present


def test_without_telemetry_a_frame_is_unknown_and_says_why() -> None:
    frame = of_a_dive(Failures()).of(0)
    assert not frame.metric
    assert frame.scale_source == WorldFrame.unknown().scale_source


# --- how often telemetry is asked -----------------------------------------------------------------


def line_of(count: int, components: int = 1) -> PoseGraph:
    """Keyframes a metre apart, linked but for the beginnings of sub-maps."""
    graph = PoseGraph()
    step = Sim3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    for k in range(count):
        graph.add_keyframe(k, Sim3(np.eye(3), np.array([float(k), 0.0, 0.0])))
        if k % (count // components):
            assert graph.add_edge(Edge(k - 1, k, step, 1e4 * np.eye(7)))
    return graph


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Keyframes of each time that telemetry was asked."""
    counts: list[int] = []
    whole = straighten

    def counting(snapshot: Snapshot, *others: Any) -> Straightened:
        counts.append(len(snapshot.nodes))
        return whole(snapshot, *others)

    monkeypatch.setattr(world_frames, "straighten", counting)
    return counts


def job_at(metric: WorldFrames, count: int, components: int = 1) -> None:
    snapshot, keyframes = line_of(count, components).snapshot(), metric._keyframes
    keyframes.keyframes[:] = [
        Keyframe(number, number, 0, Sim3.identity(), 0, keyframes) for number in range(count)
    ]
    metric.job(snapshot)(snapshot)


def test_loops_of_a_short_dive_ask_telemetry_each_time(asked: list[int]) -> None:
    metric = of_a_dive(Failures())
    metric.add(Depth(0, 0, "bar30", 3.0))
    for _ in range(2):
        job_at(metric, FEW_KEYFRAMES)
    assert asked == [FEW_KEYFRAMES, FEW_KEYFRAMES]


def test_a_long_dive_asks_telemetry_again_when_a_tenth_is_new(asked: list[int]) -> None:
    metric = of_a_dive(Failures())
    metric.add(Depth(0, 0, "bar30", 3.0))
    for count in (100, 101, 110, 111, 112):
        job_at(metric, count)
    assert asked == [100, 111]
    metric.ask_anew()
    job_at(metric, 113)
    assert asked == [100, 111, 113]


def test_sub_maps_that_were_joined_or_begun_make_it_ask_again(asked: list[int]) -> None:
    metric = of_a_dive(Failures())
    metric.add(Depth(0, 0, "bar30", 3.0))
    job_at(metric, 100)
    job_at(metric, 102, components=2)
    job_at(metric, 102, components=2)
    job_at(metric, 102)
    assert asked == [100, 102, 102]


def test_turns_of_telemetry_are_geometric_in_a_long_dive() -> None:
    metric = of_a_dive(Failures())
    metric.add(Depth(0, 0, "bar30", 3.0))
    turns = [number for number in range(4000) if metric.keyframe(number, None)]
    gaps = np.diff(turns)
    assert gaps[:8].tolist() == [20] * 8
    assert gaps[-1] > 300
    assert len(turns) < 60


def test_between_two_askings_keyframes_stay_in_the_world_that_was_found() -> None:
    """Half of them are pulled to where telemetry put them, and the others follow their links."""
    graph, pulled = line_of(100), Sim3(np.eye(3), np.array([0.0, 0.0, 0.5]))
    edges = []
    for k in range(90):
        measured = KeyframeMeasurements(
            turn=np.zeros(3), turn_sigma=(1e-3, 1e-3), depth_m=(0.5, 1e-3), scale=(1.0, 1e-3),
            place_m=(np.array([float(k), 0.0]), 1e-3),
        )  # fmt: skip
        edge = world_edge(k, graph.pose(k), measured)
        assert edge is not None
        edges.append(edge)
    snapshot = graph.snapshot()
    result = solve_with_worlds(snapshot, [])[0]
    frame = metric_frame(T_nm=Sim3.identity())
    before = Straightened(result, {0: frame}, True, (World(0, Sim3.identity(), edges),))
    assert before.fits(snapshot)
    again = straighten_again(snapshot, before)
    T_nm = again.frames[0].T_nm
    for k in (0, 50, 99):
        T_nk = T_nm @ again.result.poses.get(k, graph.pose(k))
        assert T_nk.t == pytest.approx([float(k), *pulled.t[1:]], abs=0.05)
    assert again.strained
    assert again.worlds[0].edges == edges
