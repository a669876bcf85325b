"""When Slam takes over what was optimised beside tracking."""

from __future__ import annotations

import pytest

from aquaflow.base.worker import Worker
from aquaflow.slam import Slam
from aquaflow.tracking.frames import KeyframeEdge
from aquaflow.tracking.graph.keyframe_graph import Correction
from tests.slam_scenes import OPEN_GATE, ToldTracker, config, frame_of


class ToldGraph:
    """Says what it was asked; an optimisation is at work from the first keyframe to the end."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.optimising = False

    def add(self, number: int, link: KeyframeEdge | None) -> None:
        self.asked.append(f"add {number}")
        self.optimising = True

    def adjust_everything(self) -> None:
        self.asked.append("adjust")

    def correction(self, wait: bool) -> Correction:
        self.asked.append("wait" if wait else "look")
        self.optimising &= not wait
        return Correction()


@pytest.mark.parametrize(
    ("threads", "asked"),
    [
        (False, ["wait", "add 0", "wait", "add 1", "wait", "adjust", "wait"]),
        (True, ["look", "add 0", "look", "look", "add 1", "look", "wait", "adjust", "wait"]),
    ],
)
def test_only_a_replay_waits_for_the_graph_and_only_at_keyframes(
    threads: bool, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    worker = Worker(threads=threads)
    slam, graph = Slam(config(OPEN_GATE, enabled=False), worker=worker), ToldGraph()
    monkeypatch.setattr(slam, "tracker", ToldTracker(slam, "KCKC"))
    monkeypatch.setattr(slam, "graph", graph)
    for index in range(4):
        slam.process(frame_of(index))
    slam.finish()
    assert graph.asked == asked
    worker.close()
