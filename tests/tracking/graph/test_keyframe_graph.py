"""Losing a place and finding it again: loops close, sub-maps merge, lost frames are placed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from aquaflow.config import TrackingConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.keyframes import KeyframeStore
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.tracking.frames import FrameClass, KeyframeEdge, Revisit, Step, Tracked
from aquaflow.tracking.graph.keyframe_graph import Correction, KeyframeGraph
from aquaflow.tracking.loops import Places
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame
from tests.tracking.tracking_scenes import SeaFloor, black, filmed, pose

COUNT, RADIUS_M = 24, 0.9


def circle() -> list[Sim3]:
    """Once round, back to the start, rising and sinking a little."""
    angles = np.linspace(0.0, 2.0 * np.pi, COUNT + 1)
    return [
        pose(
            (0.0, 0.0, 0.0),
            (RADIUS_M * (np.cos(a) - 1.0), RADIUS_M * np.sin(a), 0.03 * np.sin(3.0 * a)),
        )
        for a in angles
    ]


POSES = circle()


@dataclass
class Swim:
    """A tracker with its graph, fed as Slam feeds them."""

    settings: TrackingConfig = field(default_factory=TrackingConfig)

    def __post_init__(self) -> None:
        prior, self.store = ClassicalPrior(), KeyframeStore()
        places = Places(self.store, self.settings)
        self.tracker = Tracker(prior, self.store, self.settings, places)
        self.graph = KeyframeGraph(self.store, places, self.settings)
        self.tracked: list[Tracked] = []
        self.links: dict[int, KeyframeEdge] = {}
        self.anchors: dict[int, tuple[int, Sim3]] = {}
        self.corrections: list[Correction] = []

    def run(self, frames: Sequence[Frame]) -> Swim:
        for frame in frames:
            self._take(self.tracker.track(frame))
        self._take(self.tracker.finish())
        self.corrections.append(self.graph.correction(wait=True))
        return self

    def graph_of(self, other: Swim) -> KeyframeGraph:
        """This swim's graph, given the keyframes and links that ``other`` found."""
        for keyframe in other.store.keyframes:
            self.store.add(
                keyframe.frame_index, 0, keyframe.encoding, keyframe.T_wc, keyframe.pointmap, 0
            )
            self.graph.correction(wait=True)
            self.graph.add(keyframe.number, other.links.get(keyframe.number))
        self.graph.correction(wait=True)
        return self.graph

    def _take(self, step: Step) -> None:
        for tracked in step.frames:
            if tracked.T_wc is not None and tracked.keyframe is not None:
                T_kw = self.store[tracked.keyframe].T_wc.inverse()
                self.anchors[tracked.frame.index] = (tracked.keyframe, T_kw @ tracked.T_wc)
        for tracked in step.frames:
            if tracked.frame_class is FrameClass.KEYFRAME and tracked.keyframe is not None:
                self.corrections.append(self.graph.correction(wait=True))
                self.graph.add(tracked.keyframe, step.links.get(tracked.keyframe))
        for revisit in step.revisits:
            self.graph.revisit(revisit)
        self.tracked += step.frames
        self.links |= step.links

    def errors(self, poses: Sequence[Sim3]) -> np.ndarray:
        """[n, 3] m, after one similarity for all posed frames."""
        indices = sorted(self.anchors)
        found = np.array([self._pose(i).t for i in indices])
        truth = np.array([poses[i].t for i in indices])
        return align(found, truth, with_scale=True).T_target_source.apply(found) - truth

    def _pose(self, index: int) -> Sim3:
        number, T_kf = self.anchors[index]
        return self.store[number].T_wc @ T_kf

    @property
    def loops(self) -> int:
        return self.graph.loops

    @property
    def sub_maps(self) -> set[int]:
        return {keyframe.sub_map for keyframe in self.store.keyframes}


def share(errors: np.ndarray, poses: Sequence[Sim3]) -> float:
    """RMSE over the length of the path."""
    length = np.linalg.norm(np.diff([T.t for T in poses], axis=0), axis=1).sum()
    return float(np.sqrt((errors**2).sum(1).mean()) / length)


@pytest.fixture(scope="module")
def clip() -> list[Frame]:
    return filmed(SeaFloor(), POSES)


@pytest.fixture(scope="module")
def swim(clip: list[Frame]) -> Swim:
    """Once round, which nothing disturbs; only read."""
    return Swim().run(clip)


def test_a_loop_is_closed_and_the_path_stays_right(swim: Swim, clip: list[Frame]) -> None:
    assert swim.loops > 0
    assert len(swim.anchors) == len(clip)
    assert share(swim.errors(POSES), POSES) < 0.003


@pytest.fixture(scope="module")
def never_returned(clip: list[Frame]) -> Swim:
    """Once round with new keyframes only, so that loops are the graph's to find; only read."""
    return Swim(TrackingConfig(return_candidates=0)).run(clip)


def test_without_the_graph_no_loop_is_looked_for(never_returned: Swim) -> None:
    """Among the same keyframes and links, of which the graph finds loops."""
    loops = []
    for enabled in (True, False):
        settings = TrackingConfig.model_validate({"graph": {"enabled": enabled}})
        graph = Swim(settings).graph_of(never_returned)
        loops.append(graph.loops)
    assert loops[0] > loops[1] == 0


def test_drift_at_the_seam_falls_fivefold_when_the_loop_closes(never_returned: Swim) -> None:
    """A path that drifts by planted errors of its links, and one true loop, of a new keyframe."""
    swim = never_returned
    drifting = Swim()
    store, graph = drifting.store, drifting.graph.graph
    for keyframe in swim.store.keyframes:
        store.add(keyframe.frame_index, 0, keyframe.encoding, keyframe.T_wc, keyframe.pointmap, 0)
    step = Sim3.exp(np.array([0.01, 0.004, 0.006, 0.002, 0.003, 0.004, 0.01]))
    drifted = Sim3.identity()
    truth = [keyframe.T_wc for keyframe in swim.store.keyframes]
    seam = [0.0, 0.0]
    for number, keyframe in enumerate(store.keyframes):
        link = swim.links.get(number)
        keyframe.T_wc = truth[number] @ drifted
        if link is not None:
            drifted = drifted @ step
            link = replace(
                link,
                T_fk=(truth[number] @ drifted).inverse() @ store[link.keyframe].T_wc,
                covariance=1e-4 * np.eye(6),
            )
        drifting.graph.add(number, link)
        correction = drifting.graph.correction(wait=True)
        if drifting.loops and seam[0] == 0.0:
            relative = truth[0].inverse() @ truth[number]
            before = correction.moves[number].inverse() @ store[number].T_wc
            seam[0] = float(np.linalg.norm((store[0].T_wc.inverse() @ before).t - relative.t))
            after = store[0].T_wc.inverse() @ store[number].T_wc
            seam[1] = float(np.linalg.norm(after.t - relative.t))
    assert graph.component_of(len(truth) - 1) == 0
    assert seam[0] > 0.05
    assert seam[1] < seam[0] / 5.0


def test_a_sub_map_that_comes_back_to_a_known_place_is_merged(clip: list[Frame]) -> None:
    blind = range(8, 12)
    # The keyframes left last show what comes next: a lost frame would be found there.
    swim = Swim(TrackingConfig(recent_keyframes=0)).run(
        [black(f.index) if f.index in blind else f for f in clip]
    )
    assert any(tracked.sub_map == 1 for tracked in swim.tracked)
    assert swim.sub_maps == {0}
    assert len(swim.anchors) == len(clip) - len(blind)
    assert share(swim.errors(POSES), POSES) < 0.004


def test_a_jump_back_to_a_known_place_is_placed_there_at_once(clip: list[Frame]) -> None:
    back = [replace(clip[3 + i], index=12 + i) for i in range(3)]
    swim = Swim().run([*clip[:12], *back])
    assert len(swim.anchors) == 15
    assert swim.sub_maps == {0}
    assert share(swim.errors([*POSES[:12], *POSES[3:6]]), POSES[:12]) < 0.005


def test_a_lost_vehicle_is_found_at_an_earlier_keyframe(clip: list[Frame]) -> None:
    dark = [black(11 + i) for i in range(5)]
    back = [replace(clip[2 + i], index=16 + i) for i in range(2)]
    swim = Swim().run([*clip[:11], *dark, *back])
    placed = [t for t in swim.tracked if t.frame.index >= 16]
    assert [t.sub_map for t in placed] == [0] * 2
    assert all(t.T_wc is not None for t in placed)
    assert [t.frame_class for t in swim.tracked if 11 <= t.frame.index < 16] == [
        FrameClass.LOST
    ] * 5


def test_a_turn_by_90_degrees_between_two_frames_loses_nothing(clip: list[Frame]) -> None:
    turned = Sim3(so3_exp(np.array([0.0, 0.0, np.pi / 2.0])), np.zeros(3))
    after = [T @ turned for T in POSES[6:9]]
    later = [replace(frame, index=6 + i) for i, frame in enumerate(filmed(SeaFloor(), after))]
    poses = [*POSES[:6], *after]
    swim = Swim().run([*clip[:6], *later])
    assert len(swim.anchors) == 9
    assert swim.sub_maps == {0}
    assert share(swim.errors(poses), poses) < 0.005


def test_frames_that_waited_are_placed_when_the_place_is_found_again(clip: list[Frame]) -> None:
    """Three frames of another place wait for a new sub-map; then the old place is back."""
    elsewhere = filmed(
        SeaFloor(), [pose((0.0, 0.0, 0.0), (-0.9 + 0.01 * i, -2.6, 0.0)) for i in range(3)]
    )
    lost = [replace(frame, index=8 + i) for i, frame in enumerate(elsewhere)]
    back = [replace(clip[4 + i], index=11 + i) for i in range(2)]
    swim = Swim().run([*clip[:8], *lost, *back])
    assert sorted(t.frame.index for t in swim.tracked) == list(range(13))
    assert all(t.sub_map == 0 for t in swim.tracked if t.frame.index >= 11)


# --- what a repair found --------------------------------------------------------------------------


def test_a_pair_that_a_repair_joined_gets_one_edge_and_the_graphs_pose(
    clip: list[Frame],
) -> None:
    swim = Swim().run(clip[:9])
    edges, loops = len(swim.graph.snapshot.edges), swim.graph.loops
    last = swim.store.keyframes[-1]
    earlier, true = swim.store[last.number - 2], last.T_wc
    T_ke = true.inverse() @ earlier.T_wc
    last.T_wc = Sim3(true.R, true.t, 1.2 * true.scale)
    found = Revisit(last.number, earlier.number, T_ke, 1e-6 * np.eye(6), 0.005)
    for _ in range(3):
        swim.graph.revisit(found)
        swim.graph.correction(wait=True)
    assert len(swim.graph.snapshot.edges) == edges + 1
    assert swim.graph.loops == loops + 1
    assert last.T_wc.scale == pytest.approx(true.scale, rel=1e-3)
