"""The keyframe graph: edges along the path, loop closures, and their corrections (Eq. 4).

A loop starts an optimisation beside the frames, on a snapshot of the graph; its result is applied
by ``correction``. A replay waits for it at the next keyframe, so that the same frames give the same
poses however long it took; a vehicle does not wait. Keyframes and links that came meanwhile are
moved along, and loops that came meanwhile start the next optimisation.

Loops are looked for by the same worker: they may come some frames after their keyframe.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import numpy as np

from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.config import TrackingConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.frames import KeyframeEdge, Revisit
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph, edge_information, solve
from aquaflow.tracking.graph.table import GraphResult, Improvement, Snapshot
from aquaflow.tracking.loops import Places, Relocalised

LOOP_SEARCH = "loop search"
"""Name of that work."""
LINK_SCALE_SIGMA = 0.005
"""Relative scale that a link along the path may lose; on the reef clip 12 keyframes lost 5 %."""


@dataclass(frozen=True)
class LoopsFound:
    """Earlier keyframes that prove to show the place of a new one."""

    keyframe: int
    places: list[Relocalised]


@dataclass(frozen=True)
class Correction:
    """The changes that an optimisation made to keyframes and sub-maps."""

    moves: Mapping[int, Sim3] = field(default_factory=dict)
    """By keyframe number: the similarity from its old world frame to the new one."""
    merged: Mapping[int, int] = field(default_factory=dict)
    """Sub-maps that became part of another: from, into."""


class Measurements(Protocol):
    """What else than links and loops takes part in an optimisation (``tracking/metric``)."""

    @property
    def present(self) -> bool:
        """True once there is something."""
        ...

    def keyframe(self, number: int, parent: int | None) -> bool:
        """A new keyframe; True if an optimisation is due."""
        ...

    def job(self, snapshot: Snapshot) -> Callable[[Snapshot], GraphResult]:
        """The optimisation of a snapshot, or of one with better poses and edges, to be called in
        any thread."""
        ...

    def apply(self) -> None:
        """The last job's result has been taken over."""
        ...


class PullingMeasurements(Measurements, Protocol):
    """Measurements that say whether they pull."""

    @property
    def strained(self) -> bool:
        """True if keyframes are pulled at: every optimisation solves all of them."""
        ...


class Adjustments(Protocol):
    """Poses and depths of several keyframes solved together (``tracking/adjustment``)."""

    def keyframe(self, keyframe: Keyframe, link: KeyframeEdge | None, edge: Edge | None) -> None:
        """A new keyframe, how it was linked, and the edge made of that."""
        ...

    def loop(self, number: int, earlier: int) -> None:
        """Keyframe ``number`` was found to show a place of ``earlier``."""
        ...

    def window(self, number: int) -> Callable[[Snapshot], Improvement] | None:
        """The adjustment of the newest keyframes, to be called in any thread."""
        ...

    def everything(self) -> Callable[[Snapshot], Improvement] | None:
        """The adjustment of all keyframes, to be called in any thread."""
        ...

    def apply(self) -> None:
        """The last job's result has been taken over."""
        ...


class KeyframeGraph:
    """Grows with the keyframes; sets their poses and sub-maps when the graph was optimised.

    To be used from one thread: nothing changes but in its methods.
    """

    def __init__(
        self,
        keyframes: KeyframeStore,
        places: Places,
        config: TrackingConfig,
        failures: Failures | None = None,
        telemetry: PullingMeasurements | None = None,
        adjustments: Adjustments | None = None,
        scales: Measurements | None = None,
        worker: Worker | None = None,
    ) -> None:
        """``telemetry`` takes part in the optimisations, once there is some, and until then
        ``scales``; ``adjustments`` come before them, and of all keyframes after those that closed
        loops. These are looked for by ``worker``, by default at once."""
        self.graph = PoseGraph(config.graph)
        self._telemetry, self._scales = telemetry, scales
        self._failures = failures or Failures()
        self._worker = worker or Worker(self._failures)
        self._keyframes, self._places, self._config = keyframes, places, config.graph
        self._adjustment_config = config.adjustment
        self.loops = 0
        """Loop edges found."""
        self._revisited: set[tuple[int, int]] = set()
        """Pairs of keyframes that have such an edge."""
        self._known: list[Keyframe] = []
        """In the graph; the store may hold some that are not yet."""
        self._optimisation: Future[GraphResult] | None = None
        self._adjustments = adjustments
        self._to_adjust: int | None = None
        """The newest keyframe, if its window has not been adjusted."""
        self._closed, self._adjusted = False, 0
        """True if loops were closed since all keyframes were adjusted; how many those were."""
        self._due = False
        """True if loops or telemetry came that no optimisation has seen."""

    @property
    def snapshot(self) -> Snapshot:
        """The graph as it is now."""
        return self.graph.snapshot()

    @property
    def optimising(self) -> bool:
        """True if an optimisation was started and its correction has not been taken yet."""
        return self._optimisation is not None

    def add(self, number: int, link: KeyframeEdge | None) -> None:
        """Add a keyframe and its relative-pose edge to the keyframe it was tracked against.

        If it proves to close a loop, an optimisation starts, after one that is running.
        """
        keyframe = self._keyframes[number]
        if link is not None:  # the earlier one may have been moved since they were linked
            earlier = self._keyframes[link.keyframe]
            keyframe.T_wc = (earlier.T_wc @ link.T_fk.inverse()).if_finite()
            keyframe.sub_map = earlier.sub_map
        self.graph.add_keyframe(number, keyframe.T_wc)
        self._known.append(keyframe)
        edge = None
        if link is not None:
            sigma = LINK_SCALE_SIGMA
            information = edge_information(link.covariance, sigma, link.T_fk)
            edge = Edge(number, link.keyframe, link.T_fk, information)
            self.graph.add_edge(edge)
        if self._adjustments is not None:
            with self._failures.contain("joint adjustment", keyframe.frame_index):
                self._adjustments.keyframe(keyframe, link, edge)
                self._to_adjust = number
        self._look_for_loops(keyframe)
        parent = None if link is None else link.keyframe
        for measurements in (self._telemetry, self._scales):
            if measurements is not None:
                with self._failures.contain("metric frames", keyframe.frame_index):
                    self._due |= measurements.keyframe(number, parent)
        self._optimise()

    def adjust_everything(self) -> None:
        """Start a joint adjustment of all keyframes, and then an optimisation; none may run."""
        if self._adjustments is not None and self._adjustment_config.at_end:
            self._due = True
            self._optimise(everything=True)

    def revisit(self, found: Revisit) -> None:
        """Add what a frame said of two keyframes as a loop edge, the only one for this pair; the
        keyframe's pose is set to what the graph holds it to be."""
        keyframe = self._keyframes[found.keyframe]
        keyframe.T_wc = self.graph.pose(found.keyframe)
        pair = (found.keyframe, found.earlier)
        if pair in self._revisited or not self._config.enabled:
            return
        self._revisited.add(pair)
        information = edge_information(found.covariance, found.scale_sigma, found.T_ke)
        edge = Edge(found.keyframe, found.earlier, found.T_ke, information, loop=True)
        self._close(edge)
        self._optimise()

    def straighten(self) -> None:
        """Start an optimisation together with telemetry, if none is running."""
        self._due = True
        self._optimise()

    def resume(self, graph: PoseGraph, loops: int) -> None:
        """Continue with an earlier run's graph; the store holds its keyframes again.

        A keyframe whose content was lost moves with the others and is not used for relocalisation.
        """
        self.graph, self.loops = graph, loops
        self._known = [known for known in self._keyframes.keyframes if known.number in graph]
        for keyframe in self._known:
            if keyframe.number not in self._keyframes.lost:
                self._places.add(keyframe.number, keyframe.encoding)

    def correction(self, wait: bool) -> Correction:
        """The optimisation's result, once; empty if there is none, or it is still running.

        ``wait``: block until it has ended. An error in its thread counts as a failure here.
        """
        self._optimise()  # of loops that were found since
        if self._optimisation is None or not (wait or self._optimisation.done()):
            return Correction()
        finished, self._optimisation = self._optimisation, None
        correction = Correction()
        with self._failures.contain("graph optimisation"):
            result = self.graph.apply(finished.result())
            assert result is not None  # only this method applies results
            correction = self._taken_over(result)
            for taking_part in (self._adjustments, self._telemetry):
                if taking_part is not None:
                    taking_part.apply()
        self._optimise(everything=self._loops_to_adjust())
        return correction

    def _loops_to_adjust(self) -> bool:
        """True if loops were closed, the graph has taken them in, and it is not too soon."""
        count, config = len(self._known), self._adjustment_config
        enough = max(config.at_loops, config.at_loops_share * self._adjusted)
        return (
            self._closed
            and not self._due
            and config.at_loops > 0
            and enough <= count - self._adjusted
            and count <= config.most_at_loops
        )

    def _optimise(self, everything: bool = False) -> None:
        """Start an adjustment or optimisation if there is something new and none is running."""
        if self._optimisation is not None:
            return
        job = self._adjustment(everything)
        if job is None and not self._due:
            return
        snapshot, optimise = self.graph.snapshot(), None
        with_telemetry = self._telemetry is not None and self._telemetry.present
        if self._telemetry is not None and with_telemetry and self._due:
            optimise = self._telemetry.job(snapshot)
        elif not with_telemetry and self._scales is not None and self._scales.present:
            optimise = self._scales.job(snapshot)
        elif not with_telemetry:
            optimise = solve
        self._due = False
        self._optimisation = self._worker.start(partial(self._improve, job, snapshot, optimise))

    def _adjustment(self, everything: bool) -> Callable[[Snapshot], Improvement] | None:
        number, self._to_adjust = self._to_adjust, None
        if self._adjustments is not None:
            with self._failures.contain("joint adjustment"):
                if everything:
                    self._closed, self._adjusted = False, len(self._known)
                    return self._adjustments.everything()
                return None if number is None else self._adjustments.window(number)
        return None

    def _improve(
        self,
        adjust: Callable[[Snapshot], Improvement] | None,
        snapshot: Snapshot,
        optimise: Callable[[Snapshot], GraphResult] | None,
    ) -> GraphResult:
        """Beside the frames: adjust, then optimise with what that found. Without ``optimise``
        telemetry's next turn does it: what it straightened must not be bent back meanwhile."""
        better = Improvement.none()
        if adjust is not None:
            with self._failures.contain("joint adjustment"):
                better = adjust(snapshot)
        if optimise is None:
            return better.alone(snapshot)
        return better.within(optimise(better.of(snapshot)), snapshot)

    def _look_for_loops(self, keyframe: Keyframe) -> None:
        """Search the known places for the new keyframe's, and make it one of them."""
        number, frame, places = keyframe.number, keyframe.frame_index, self._places
        with self._failures.contain(LOOP_SEARCH, frame):
            encoding, pointmap = keyframe.encoding, keyframe.pointmap.copy()  # fused meanwhile
            known: list[LoopsFound] = []
            if self._config.enabled:
                near = self._on_the_path(number)
                search = partial(self._search, number, encoding, pointmap, near)
                known = self._worker.ask(LOOP_SEARCH, frame, search)
            self._worker.ask("place index", frame, partial(places.add, number, encoding))
            for found in known:
                self.close_loops(found)

    def _search(
        self, number: int, encoding: Encoding, pointmap: Pointmap, near: Container[int]
    ) -> LoopsFound:
        return LoopsFound(number, self._places.of_keyframe(encoding, pointmap, near))

    def _on_the_path(self, number: int) -> Container[int]:
        """The keyframes just before ``number``, of whose place the path knows anyway."""
        component = self.graph.component_of(number)
        before = range(max(0, number - self._config.loop_gap + 1), number)
        known = {other for other in before if other in self.graph}
        return {other for other in known if self.graph.component_of(other) == component}

    def close_loops(self, found: LoopsFound) -> None:
        """Edges to all earlier keyframes that prove to show the same place."""
        number = found.keyframe
        for place in found.places:
            T_fk, covariance = place.estimate.T, place.estimate.covariance
            sigma = float(np.sqrt(covariance[6, 6]))
            information = edge_information(covariance[:6, :6], sigma, T_fk)
            edge = Edge(number, place.keyframe.number, T_fk, information, loop=True)
            if self._close(edge):
                self._closed = True
                if self._adjustments is not None:
                    self._adjustments.loop(number, place.keyframe.number)

    def _close(self, loop: Edge) -> bool:
        """Add a loop edge; False if it was refused. Where telemetry pulls at all keyframes, one
        that says nothing new waits for its next turn: an area flown again has one for every
        keyframe, and with 3,300 of them a solution takes 5.6 s (notes/2026-11-speed.md#hour)."""
        if not self.graph.add_edge(loop):
            return False
        telemetry = self._telemetry
        pulls = telemetry is not None and telemetry.present and telemetry.strained
        self._due |= not (pulls and self.graph.newest_agrees())
        self.loops += 1
        return True

    def _taken_over(self, result: GraphResult) -> Correction:
        """Apply the result to the keyframes."""
        moves, merged = {}, {}
        if result.poses:  # all at once: one by one, 10^4 keyframes would take half a second
            keyframes = [self._keyframes[number] for number in result.poses]
            before = Sim3Batch.of([keyframe.T_wc for keyframe in keyframes])
            change = (Sim3Batch.of([*result.poses.values()]) @ before.inverse()).on_group()
            for i, keyframe in enumerate(keyframes):
                moves[keyframe.number] = change.element(i)
                keyframe.T_wc = result.poses[keyframe.number]
        for keyframe in self._known:
            root = self._keyframes[self.graph.component_of(keyframe.number)]
            if keyframe.sub_map != root.sub_map:
                merged[keyframe.sub_map] = root.sub_map
                keyframe.sub_map = root.sub_map
        return Correction(moves, merged)
