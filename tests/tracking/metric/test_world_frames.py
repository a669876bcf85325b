"""Telemetry that cannot be used costs itself: neither the loops nor the frames known before."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.config import FusionConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frame_table import FrameTable
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph
from aquaflow.tracking.metric import world_frames
from aquaflow.tracking.metric.world_frames import WorldFrames
from aquaflow.types import AngularRate, Depth


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
