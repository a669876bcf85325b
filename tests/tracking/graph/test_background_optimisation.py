"""The keyframe graph is optimised beside tracking: nothing waits for it that was not told to."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from concurrent import futures
from dataclasses import dataclass, field
from threading import Event
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from aquaflow.base.worker import Worker
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore, Pointmap
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.frames import KeyframeEdge
from aquaflow.tracking.graph import keyframe_graph
from aquaflow.tracking.graph.keyframe_graph import Correction, KeyframeGraph, PullingMeasurements
from aquaflow.tracking.graph.table import GraphResult, Snapshot
from aquaflow.tracking.loops import Places, Relocalised
from aquaflow.tracking.pose.solver import Degeneracy, PoseEstimate
from tests.tracking.graph.graph_scenes import LOOP_SIGMA, SIGMA, circle

COUNT = 24
TRUTH = circle(COUNT)
CAMERA = CameraModel(4, 3, 4.0, 4.0, 2.0, 1.5)
SOLVE = keyframe_graph.solve
KNOWN = cast(Degeneracy, None)


def between(a: int, b: int) -> Sim3:
    return TRUTH.element(a).inverse() @ TRUTH.element(b)


@dataclass
class KnownPlaces:
    """By keyframe: the earlier one whose place it is proven to show."""

    store: KeyframeStore
    again: dict[int, int]
    go_on: Event | None = None
    """Set to let searches end; None: they do at once."""

    def add(self, number: int, encoding: Encoding) -> None:
        pass

    def of_keyframe(
        self, encoding: Encoding, pointmap: Pointmap, besides: Container[int]
    ) -> list[Relocalised]:
        assert self.go_on is None or self.go_on.wait(60.0)
        number = cast(SimpleNamespace, encoding).number
        if number not in self.again:
            return []
        past = self.again[number]
        covariance = np.diag(LOOP_SIGMA**2)
        estimate = PoseEstimate(between(number, past), covariance, 1.0, 0.0, 1.0, KNOWN)
        return [Relocalised(self.store[past], estimate)]


@dataclass
class Pulling:
    """Telemetry that pulls at all keyframes, and whose turn comes every so many of them."""

    turn: int
    strained: bool = True
    present: bool = True

    def keyframe(self, number: int, parent: int | None) -> bool:
        return number > 0 and number % self.turn == 0

    def job(self, snapshot: Snapshot) -> Callable[[Snapshot], GraphResult]:
        return keyframe_graph.solve

    def apply(self) -> None:
        pass


@dataclass
class Drifting:
    """Keyframes on a circle whose links all err the same way, and the loops that close it."""

    loops: dict[int, int]
    store: KeyframeStore = field(default_factory=KeyframeStore)
    go_on: Event | None = None
    """If there is one, loops are looked for in a thread, and found once it is set."""
    telemetry: PullingMeasurements | None = None
    drift: float = 1.0
    """Error of a link in yaw and scale, in sigmas."""

    def __post_init__(self) -> None:
        places = cast(Places, KnownPlaces(self.store, self.loops, self.go_on))
        self.worker = Worker(threads=self.go_on is not None)
        self.graph = KeyframeGraph(
            self.store, places, TrackingConfig(), telemetry=self.telemetry, worker=self.worker
        )
        error = Sim3.exp(self.drift * SIGMA * np.array([0, 0, 0, 0, 0, 1, 1]))
        self.link_T = [(between(i, i + 1) @ error).inverse() for i in range(COUNT - 1)]

    def add(self, number: int) -> None:
        link, T_wc = None, Sim3.identity()
        if number:
            T_fk = self.link_T[number - 1]
            T_wc = self.store[number - 1].T_wc @ T_fk.inverse()
            link = KeyframeEdge(number - 1, T_fk, np.diag(SIGMA[:6] ** 2))
        nothing = cast(Encoding, SimpleNamespace(camera=CAMERA, number=number))
        self.store.add(number, number, nothing, T_wc, Pointmap.unknown(CAMERA), 0)
        self.graph.add(number, link)

    def close_loops(self, wait: bool = False) -> None:
        """Those that were found since."""
        for each in self.worker.take_finished(wait):
            if each.found is not None:
                self.graph.close_loops(each.found)

    def seam_m(self, a: int, b: int) -> float:
        found = self.store[a].T_wc.inverse() @ self.store[b].T_wc
        return float(np.linalg.norm(found.t - between(a, b).t))


@dataclass
class Held:
    """Lets every optimisation wait until it is told to go on."""

    go_on: Event = field(default_factory=Event)
    solved: list[int] = field(default_factory=list)
    """Keyframes in each snapshot."""

    def solve(self, snapshot: Snapshot) -> GraphResult:
        assert self.go_on.wait(60.0)
        self.solved.append(len(snapshot.nodes))
        return SOLVE(snapshot)


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> Iterator[Held]:
    held = Held()
    monkeypatch.setattr(keyframe_graph, "solve", held.solve)
    yield held
    held.go_on.set()  # lets the thread end if the test has failed


def test_tracking_goes_on_while_a_loop_is_optimised(held: Held) -> None:
    dive = Drifting({20: 0})
    for number in range(COUNT):
        dive.add(number)
        assert dive.graph.correction(wait=False) == Correction()
    assert dive.graph.optimising
    assert held.solved == []


def test_keyframes_that_came_meanwhile_go_along_with_the_result(held: Held) -> None:
    dive = Drifting({20: 0})
    for number in range(COUNT):
        dive.add(number)
    before = {number: dive.store[number].T_wc for number in range(COUNT)}
    drifted = dive.seam_m(0, 20)
    held.go_on.set()
    moves = dive.graph.correction(wait=True).moves
    assert dive.seam_m(0, 20) < drifted / 3.0
    assert set(range(20, COUNT)) <= set(moves)
    for number, S in moves.items():
        moved = S @ before[number]
        np.testing.assert_allclose(moved.matrix, dive.store[number].T_wc.matrix, atol=1e-9)
    for number in range(21, COUNT):  # still linked as they were
        T = dive.store[number].T_wc.inverse() @ dive.store[number - 1].T_wc
        np.testing.assert_allclose(T.matrix, dive.link_T[number - 1].matrix, atol=1e-9)


def test_loops_that_came_meanwhile_start_the_next_optimisation(held: Held) -> None:
    dive = Drifting({20: 0, 21: 1, 23: 2})
    for number in range(COUNT):
        dive.add(number)
    held.go_on.set()
    while dive.graph.optimising:
        dive.graph.correction(wait=True)
    assert held.solved == [21, COUNT]
    assert dive.graph.loops == 3


def test_a_loop_that_is_found_some_keyframes_later_closes_all_the_same() -> None:
    dive = Drifting({20: 0}, go_on=Event())
    assert dive.go_on is not None
    for number in range(COUNT):
        dive.add(number)
        dive.close_loops()
        assert dive.graph.correction(wait=False) == Correction()
    assert dive.graph.loops == 0
    drifted = dive.seam_m(0, 20)
    dive.go_on.set()
    dive.close_loops(wait=True)
    assert dive.graph.loops == 1
    assert dive.graph.correction(wait=True).moves
    assert dive.seam_m(0, 20) < drifted / 3.0
    dive.worker.close()


def test_a_correction_is_told_once() -> None:
    dive = Drifting({20: 0})
    for number in range(21):
        dive.add(number)
    assert dive.graph.correction(wait=True).moves
    assert not dive.graph.optimising
    assert dive.graph.correction(wait=True) == Correction()


def test_without_a_loop_nothing_is_optimised() -> None:
    dive = Drifting({})
    for number in range(COUNT):
        dive.add(number)
    assert not dive.graph.optimising


@pytest.mark.parametrize(("drift", "solved"), [(0.01, 1), (1.0, 2)])
def test_a_loop_that_says_nothing_new_waits_for_the_turn_of_telemetry_that_pulls(
    drift: float, solved: int, held: Held
) -> None:
    held.go_on.set()
    dive = Drifting({14: 0}, telemetry=Pulling(turn=20), drift=drift)
    for number in range(COUNT):
        dive.add(number)
        dive.graph.correction(wait=True)
    assert dive.graph.loops == 1
    assert held.solved == [15, 21][-solved:]
    snapshot = dive.graph.snapshot
    assert snapshot.trust["trust"][snapshot.edges["loop"]].tolist() == [1.0]


def test_where_telemetry_does_not_pull_a_loop_that_says_nothing_new_is_solved_at_once(
    held: Held,
) -> None:
    held.go_on.set()
    dive = Drifting({14: 0}, telemetry=Pulling(turn=20, strained=False), drift=0.01)
    for number in range(16):
        dive.add(number)
        dive.graph.correction(wait=True)
    assert held.solved == [15]


def test_waiting_at_the_next_keyframe_gives_the_same_poses_however_long_it_took(
    held: Held,
) -> None:
    def swum(slow: bool) -> list[bytes]:
        dive = Drifting({16: 0, 20: 1, 22: 2})
        for number in range(COUNT):
            if slow:
                held.go_on.clear()
            dive.add(number)
            if not slow and dive.graph._optimisation is not None:
                futures.wait([dive.graph._optimisation])
            held.go_on.set()
            dive.graph.correction(wait=True)
        return [keyframe.T_wc.matrix.tobytes() for keyframe in dive.store.keyframes]

    slowly = swum(slow=True)
    assert swum(slow=False) == slowly
    assert len(held.solved) == 6


def test_what_is_raised_in_the_thread_is_raised_where_the_result_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def too_large(snapshot: Snapshot) -> GraphResult:
        raise MemoryError("no room for the factor")

    dive = Drifting({20: 0, 22: 1})
    monkeypatch.setattr(keyframe_graph, "solve", too_large)
    for number in range(21):
        dive.add(number)
    with pytest.raises(MemoryError, match="no room for the factor"):
        dive.graph.correction(wait=True)
    assert not dive.graph.optimising
    monkeypatch.setattr(keyframe_graph, "solve", SOLVE)
    for number in range(21, 23):
        dive.add(number)
    drifted = dive.seam_m(0, 20)
    assert dive.graph.correction(wait=True).moves  # the next loop takes up what was left
    assert dive.seam_m(0, 20) < drifted / 3.0
