"""Keyframes over a rendered sea floor: windows are adjusted, in any order of the threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.config import TrackingConfig
from aquaflow.config.tracking import AdjustmentConfig, GraphConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore, Pointmap
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.flow_pair import FlowEncoding, FlowPair
from aquaflow.tracking.adjustment.adjuster import Adjuster
from aquaflow.tracking.frames import KeyframeEdge
from aquaflow.tracking.graph.keyframe_graph import KeyframeGraph
from aquaflow.tracking.graph.pose_graph import Edge
from aquaflow.tracking.graph.table import Improvement, Snapshot
from aquaflow.tracking.loops import Places
from tests.tracking.tracking_scenes import CAMERA, Array, SeaFloor, lawn_path

COUNT = 7
STEP_M = 0.22
LENGTH_ERROR = 0.03
"""Relative, of every link, in turn too long and too short: what an adjustment has to find."""


PATH, PRIOR = lawn_path(COUNT, STEP_M), ClassicalPrior()


@cache
def floor() -> SeaFloor:
    return SeaFloor()


@cache
def depth(place: int) -> Array:
    return floor().depth(PATH[place])


@cache
def seen(place: int) -> FlowEncoding:
    return PRIOR.encode(floor().picture(PATH[place]), CAMERA)


@cache
def matched(place: int, other: int) -> FlowPair:
    return PRIOR.decode(seen(place), seen(other))


@dataclass
class Swim:
    """Keyframes with true depths whose links have wrong lengths, handed to a graph one by one."""

    adjuster: Adjuster
    graph: KeyframeGraph
    store: KeyframeStore
    failures: Failures
    wait: bool = True
    places: Sequence[int] = range(COUNT)
    """Of PATH, where the keyframes are."""

    @property
    def truth(self) -> list[Sim3]:
        return [PATH[place] for place in self.places]

    def add(self, number: int) -> None:
        """The keyframe ``number`` of the dive."""
        T_wc = self.truth[0] if number == 0 else self.store[number - 1].T_wc
        place = self.places[number]
        rho = 1.0 / depth(place)
        pointmap = Pointmap(CAMERA, rho, (0.02 * rho) ** 2)
        self.store.add(number, number, seen(place), T_wc, pointmap, 0)
        link = None
        if number > 0:
            T = self.truth[number].inverse() @ self.truth[number - 1]
            T_fk = Sim3(T.R, (1.0 + LENGTH_ERROR * (-1) ** number) * T.t)
            pair = matched(self.places[number - 1], place)
            link = KeyframeEdge(number - 1, T_fk, np.diag([0.02] * 3 + [0.002] * 3) ** 2, pair)
        if self.wait:
            self.graph.correction(wait=True)
        self.graph.add(number, link)

    def end(self) -> Array:
        """[COUNT, 3] centres at the end of the dive."""
        while self.graph.optimising:
            self.graph.correction(wait=True)
        self.graph.adjust_everything()
        while self.graph.optimising:
            self.graph.correction(wait=True)
        return np.array([keyframe.T_wc.t for keyframe in self.store.keyframes])

    def error(self, centres: Array) -> float:
        """Spread of the steps' lengths over the true ones, relative."""
        true = np.array([T.t for T in self.truth])[: len(centres)]
        ratio = _steps(centres) / _steps(true)
        return float(ratio.std() / ratio.mean())


def _steps(
    centres: Array,  # [N, 3]
) -> Array:
    return np.asarray(np.linalg.norm(np.diff(centres, axis=0), axis=1))


@pytest.fixture
def swim() -> Iterator[Callable[..., Swim]]:
    workers: list[Worker] = []

    def make(wait: bool = True, **settings: object) -> Swim:
        store, failures = KeyframeStore(), Failures(strict=False)
        adjustment = AdjustmentConfig.model_validate(settings)
        config = TrackingConfig(adjustment=adjustment, graph=GraphConfig(loop_gap=3))
        adjuster = Adjuster(store, adjustment)
        worker = Worker(failures)
        workers.append(worker)
        graph = KeyframeGraph(
            store, Places(store, config), config, failures, None, adjuster, worker=worker
        )
        return Swim(adjuster, graph, store, failures, wait)

    yield make
    for each in workers:
        each.close()


def test_lengths_of_links_come_right(swim: Callable[..., Swim]) -> None:
    dive = swim()
    for number in range(COUNT):
        dive.add(number)
    centres = dive.end()
    assert dive.adjuster.tally.kept > 0
    assert dive.error(centres) < 0.2 * LENGTH_ERROR
    assert dive.failures.to_json() == []


def test_the_same_keyframes_give_the_same_bytes(swim: Callable[..., Swim]) -> None:
    found = []
    for _ in range(2):
        dive = swim()
        for number in range(5):
            dive.add(number)
        found.append(dive.end().tobytes())
    assert found[0] == found[1]


def test_a_live_dive_adds_keyframes_while_a_window_is_adjusted(
    swim: Callable[..., Swim],
) -> None:
    dive = swim(wait=False)
    for number in range(COUNT):
        dive.add(number)
        dive.graph.correction(wait=False)
    assert dive.error(dive.end()) < 0.2 * LENGTH_ERROR
    assert dive.failures.to_json() == []


def test_a_keyframe_whose_content_was_lost_is_matched_no_more(swim: Callable[..., Swim]) -> None:
    dive = swim()
    for number in range(4):
        dive.add(number)
    dive.graph.correction(wait=True)
    dive.store.lost |= {1, 2}
    dive.add(4)
    assert np.isfinite(dive.end()).all()
    assert dive.failures.to_json() == []


def test_a_resumed_dive_adjusts_what_it_has_seen_itself(swim: Callable[..., Swim]) -> None:
    first = swim()
    for number in range(3):
        first.add(number)
    first.end()
    again = Adjuster(first.store, AdjustmentConfig())
    assert again.window(2) is None
    assert again.everything() is None
    keyframe = first.store[2]
    link = KeyframeEdge(1, Sim3.identity(), np.eye(6))
    again.keyframe(keyframe, link, Edge(2, 1, Sim3.identity(), np.eye(7)))
    job = again.window(2)
    assert job is not None
    assert len(job(first.graph.snapshot).nodes) == 0  # nothing to judge it by


def test_a_failed_adjustment_is_counted_and_costs_nothing_else(
    swim: Callable[..., Swim], monkeypatch: pytest.MonkeyPatch
) -> None:
    dive = swim()

    def fails(number: int) -> Callable[[Snapshot], Improvement]:
        def job(snapshot: Snapshot) -> Improvement:
            raise np.linalg.LinAlgError("singular")

        return job

    monkeypatch.setattr(dive.adjuster, "window", fails)
    monkeypatch.setattr(dive.adjuster, "everything", lambda: None)
    for number in range(3):
        dive.add(number)
    centres = dive.end()
    (kind,) = dive.failures.to_json()
    assert kind["stage"] == "joint adjustment"
    assert dive.error(centres) == pytest.approx(LENGTH_ERROR, rel=0.01), "as linked"


def test_pictures_that_no_flow_can_read_are_left_alone() -> None:
    class Described:
        camera = CAMERA

    store = KeyframeStore()
    keyframe = store.add(0, 0, Described(), Sim3.identity(), Pointmap.unknown(CAMERA), 0)  # type: ignore[arg-type]
    adjuster = Adjuster(store, AdjustmentConfig())
    adjuster.keyframe(keyframe, None, None)
    assert adjuster.window(0) is None


def test_the_window_is_as_long_as_the_config_says(swim: Callable[..., Swim]) -> None:
    dive = swim(window=3)
    asked: list[int] = []
    job_of = dive.adjuster._job

    def noted(numbers: list[int], *others: object) -> object:
        asked.append(len(numbers))
        return job_of(numbers, *others)  # type: ignore[arg-type]

    dive.adjuster._job = noted  # type: ignore[assignment, method-assign]
    for number in range(5):
        dive.add(number)
    dive.end()
    assert max(asked[:-1]) == 3
    assert asked[-1] == 5, "all of them, at the end"


# --- loops ----------------------------------------------------------------------------------------


OUT_AND_BACK = (0, 1, 2, 3, 4, 5, 3, 1)
"""Places of the path, of which the last ones are those of the first again."""


def looped(dive: Swim, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Keyframes over places of OUT_AND_BACK; returns how many there were at each adjustment of
    all of them, before the end."""
    dive.places, asked = OUT_AND_BACK, []
    everything = dive.adjuster.everything
    monkeypatch.setattr(
        dive.adjuster, "everything", lambda: (asked.append(len(dive.store)), everything())[1]
    )
    for number in range(len(dive.places)):
        dive.add(number)
    while dive.graph.optimising:
        dive.graph.correction(wait=True)
    return asked


def test_after_loops_all_keyframes_are_adjusted_and_the_loops_matched(
    swim: Callable[..., Swim], monkeypatch: pytest.MonkeyPatch
) -> None:
    dive = swim(at_loops=2)
    asked = looped(dive, monkeypatch)
    assert dive.graph.loops > 0
    assert asked
    edges = dive.graph.snapshot.edges
    loops = edges[edges["loop"]]
    seen = dive.adjuster._points
    assert any(int(a) in seen[int(b)].seen for a, b in zip(loops["a"], loops["b"], strict=True))
    assert dive.error(dive.end()) < 0.2 * LENGTH_ERROR
    assert dive.failures.to_json() == []


@pytest.mark.parametrize("settings", [{"at_loops": 0}, {"at_loops": 9}, {"most_at_loops": 3}])
def test_loops_are_left_to_the_end_where_the_config_says_so(
    swim: Callable[..., Swim], monkeypatch: pytest.MonkeyPatch, settings: dict[str, int]
) -> None:
    assert looped(swim(**{"at_loops": 2, **settings}), monkeypatch) == []


def test_the_more_keyframes_were_adjusted_the_more_must_come_before_the_next_time(
    swim: Callable[..., Swim], monkeypatch: pytest.MonkeyPatch
) -> None:
    often = looped(swim(at_loops=1, at_loops_share=0.0), monkeypatch)
    assert len(often) > 1
    monkeypatch.undo()
    seldom = looped(swim(at_loops=1, at_loops_share=1.0), monkeypatch)
    assert seldom == often[:1]
