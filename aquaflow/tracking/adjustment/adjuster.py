"""Joint adjustments of a growing keyframe graph: what they need is collected here.

In the tracking thread :meth:`Adjuster.keyframe` takes what a new keyframe brings, and
:meth:`Adjuster.window` hands over all that an adjustment reads, as a job for the
graph's thread; :meth:`Adjuster.applied` keeps the matches that it made.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import thread_time

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.config.tracking import AdjustmentConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.prior.contract import Encoding
from aquaflow.prior.flow import FlowMatcher
from aquaflow.prior.flow_pair import FlowEncoding, FlowPair, best_flow, from_prediction
from aquaflow.tracking.adjustment.equations import (
    AnchoredPoints,
    AnchorMatches,
    Array,
    Index,
    Links,
    Mask,
    sampled_points,
    see_each_other,
)
from aquaflow.tracking.adjustment.joint import (
    JointAdjustmentResult,
    JointProblem,
    adjust,
    covariance,
    of_edge,
)
from aquaflow.tracking.adjustment.stored_matches import MadeMatches
from aquaflow.tracking.frames import KeyframeEdge
from aquaflow.tracking.graph.equations import poses_of
from aquaflow.tracking.graph.pose_graph import Edge
from aquaflow.tracking.graph.table import Improvement, Snapshot, write_poses
from aquaflow.tracking.pose.matcher import expected_matches

Adjust = Callable[[Snapshot], Improvement]
"""A job for any thread."""

MOST_LOOPS = 4
"""Loops whose keyframes one adjustment matches, evenly chosen: what they show may have to be read
from disk, while the camera waits."""
LEAST_SHARE = 0.05
"""Of a keyframe's points that another must see for the pair to be of use."""


@dataclass
class Tally:
    """What became of the adjustments so far."""

    kept: int = 0
    refused: int = 0
    """The points held out of it did not fit better."""
    cpu_ms: list[float] = field(default_factory=list)
    """Of each adjustment, matching included."""

    def to_json(self) -> dict[str, float | int | None]:
        """The tally as metrics.json has it."""
        times = np.array(self.cpu_ms)
        mean, p95 = (
            (round(float(each), 1) for each in (times.mean(), np.percentile(times, 95)))
            if len(times)
            else (None, None)
        )
        return {"kept": self.kept, "refused": self.refused, "cpu_ms_mean": mean, "cpu_ms_p95": p95}


@dataclass(frozen=True)
class AdjustmentJob:
    """An adjustment to be done in any thread."""

    numbers: Sequence[int]
    """Keyframes, the oldest first."""
    held: frozenset[int]
    """Those whose pose stays."""
    points: dict[int, AnchoredPoints]
    links: dict[int, MeasuredLink]
    pairs: Sequence[tuple[KeyframeView, KeyframeView]]
    """Keyframes to be matched, the earlier one first."""
    certain: bool
    """Whether edges get the covariance that the adjustment finds."""

    def within(self, known: Container[int]) -> AdjustmentJob:
        """The part of it that is ``known``: a keyframe may be missing from the graph, and what was
        linked to it is held."""
        numbers = [number for number in self.numbers if number in known]
        orphans = {n for n in numbers if n in self.links and self.links[n].parent not in known}
        pairs = [each for each in self.pairs if all(view.number in numbers for view in each)]
        return replace(self, numbers=numbers, held=self.held | orphans, pairs=pairs)


@dataclass(frozen=True)
class AdjustmentOutcome:
    """What a job found."""

    points: dict[int, AnchoredPoints]
    kept: bool
    cpu_ms: float


class Adjuster:
    """Collects anchored points and links; makes jobs of them."""

    def __init__(
        self, keyframes: KeyframeStore, config: AdjustmentConfig, work: Path | None = None
    ) -> None:
        """What an adjustment of many keyframes has no room for waits in the folder ``work``."""
        self.tally = Tally()
        self._work = work
        self._keyframes, self._config = keyframes, config
        self._points: dict[int, AnchoredPoints] = {}
        self._links: dict[int, MeasuredLink] = {}
        self._pairs = KeyframePairs()
        self._loops: list[tuple[int, int]] = []
        """Earlier and later keyframe of loops that were not matched yet."""
        self._outcome: AdjustmentOutcome | None = None
        """Set in the thread of the last job."""

    def keyframe(self, keyframe: Keyframe, link: KeyframeEdge | None, edge: Edge | None) -> None:
        """Take the points of a new keyframe, and the matches that its link was solved from.

        Raises:
            InputError: what a keyframe shows cannot be read back.
        """
        encoding = keyframe.encoding
        if not isinstance(encoding, FlowEncoding):
            return
        number = keyframe.number
        points = sampled_points(
            number, keyframe.pointmap, encoding.texture, encoding.interesting, self._config.points
        )
        self._points[number] = points
        if link is None or edge is None:
            return
        self._links[number] = MeasuredLink(edge.b, edge.T_ab, edge.information)
        parent = self._points.get(link.keyframe)
        if parent is not None:
            parent.take_depths(self._keyframes[link.keyframe].pointmap)
            if link.pair is not None:
                see_each_other(parent, points, link.pair)

    def loop(self, number: int, earlier: int) -> None:
        """Keyframe ``number`` shows a place of ``earlier``: the next adjustment of all matches
        them."""
        self._loops.append((earlier, number))

    def window(self, number: int) -> Adjust | None:
        """The newest keyframes along the links that lead to ``number``; None for fewer than two."""
        chain = [number]
        while len(chain) < self._config.window and chain[-1] in self._links:
            chain.append(self._links[chain[-1]].parent)
        if len(chain) < 2 or number not in self._points:
            return None
        reached = [n for n in chain[2 : self._config.reach + 1] if n in self._points]
        pairs = [(earlier, number) for earlier in reached]
        return partial(self._run, self._job(chain[::-1], frozenset(chain[-1:]), pairs, True))

    def everything(self) -> Adjust | None:
        """All keyframes along links, and the pairs of the loops since the last time; keyframes
        without a link stay where they are."""
        numbers = sorted(set(self._links) | {link.parent for link in self._links.values()})
        roots = frozenset(number for number in numbers if number not in self._links)
        loops, self._loops = self._loops[:: -(-len(self._loops) // MOST_LOOPS) or 1], []
        if not numbers:
            return None
        pairs = [(a, b) for a, b in loops if a in self._points and b in self._points]
        return partial(self._run, self._job(numbers, roots, pairs, False))

    def _job(
        self,
        numbers: Sequence[int],
        held: frozenset[int],
        pairs: Sequence[tuple[int, int]],
        certain: bool,
    ) -> AdjustmentJob:
        points = {n: copy(self._points[n]) for n in numbers if n in self._points}
        links = {n: self._links[n] for n in numbers if n in self._links}
        views = {n: self._view(n) for n in {n for pair in pairs for n in pair}}
        found = [(views[a], views[b]) for a, b in pairs]
        seen = [(a, b) for a, b in found if a is not None and b is not None]
        return AdjustmentJob(numbers, held, points, links, seen, certain)

    def _view(self, number: int) -> KeyframeView | None:
        keyframe = self._keyframes[number]
        try:
            return KeyframeView(number, keyframe.encoding, keyframe.pointmap.copy())
        except InputError:
            return None

    def _run(self, job: AdjustmentJob, snapshot: Snapshot) -> Improvement:
        """Match and adjust, in any thread.

        Raises:
            numpy.linalg.LinAlgError: the equations cannot be solved.
        """
        began = thread_time()
        row = {int(number): i for i, number in enumerate(snapshot.nodes["number"])}
        job = job.within(row)
        if len(job.numbers) < 2:
            return Improvement.none()
        nodes = np.array([row[number] for number in job.numbers], dtype=np.intp)
        poses = poses_at(snapshot, nodes)
        self._match(job, {n: poses.element(i) for i, n in enumerate(job.numbers)})
        held = np.array([number in job.held for number in job.numbers], dtype=bool)
        problem = problem_of(job.numbers, job.points, job.links, poses, held, self._work)
        adjusted = adjust(problem, self._config.iterations)
        found = Improvement.none()
        if adjusted.better:
            found = improvement_of(snapshot, nodes, problem, adjusted, job.certain)
        spent = 1e3 * (thread_time() - began)
        self._outcome = AdjustmentOutcome(job.points, adjusted.better, spent)
        return found

    def _match(self, job: AdjustmentJob, poses: dict[int, Sim3]) -> None:
        for earlier, later in job.pairs:
            T_ba = poses[later.number].inverse() @ poses[earlier.number]
            pair = self._pairs.match(earlier, later, T_ba)
            if pair is not None and float(pair.valid.mean()) > LEAST_SHARE:
                see_each_other(job.points[earlier.number], job.points[later.number], pair)

    def apply(self) -> None:
        """Keep the matches that the last job made, and count it."""
        outcome, self._outcome = self._outcome, None
        if outcome is None:
            return
        for number, points in outcome.points.items():
            own = self._points[number].seen
            own.update({other: at for other, at in points.seen.items() if other not in own})
        self.tally.kept += int(outcome.kept)
        self.tally.refused += int(not outcome.kept)
        self.tally.cpu_ms.append(outcome.cpu_ms)


# --------------------------------------------------------------------------------------------------
# Matches between keyframes that the graph's thread makes: dense flow from where poses lead.


@dataclass(frozen=True)
class KeyframeView:
    """What matching needs of a keyframe; nothing of it changes later."""

    number: int
    encoding: Encoding
    pointmap: Pointmap


class KeyframePairs:
    """Matches pairs of keyframes; for one thread, because OpenCV's flow keeps a state."""

    def __init__(self) -> None:
        self._matcher = FlowMatcher()

    def match(self, a: KeyframeView, b: KeyframeView, T_ba: Sim3) -> FlowPair | None:
        """The pair's matches, looked for where ``T_ba`` leads to and nowhere else; None for
        pictures that were not made ready for flow."""
        first, second = a.encoding, b.encoding
        if not (isinstance(first, FlowEncoding) and isinstance(second, FlowEncoding)):
            return None
        expected = expected_matches(a.pointmap, T_ba, b.pointmap.camera)
        return FlowPair(
            first, second, best_flow(self._matcher, first, second, from_prediction(expected))
        )


# --------------------------------------------------------------------------------------------------
# The problem of an adjustment, put together from anchored points, links and a snapshot.

KNOWN_SIGMA = 0.15
"""Relative: a depth that the pointmap knows worse says nothing."""
LEAST_SIGMA = 1e-6
"""Of an edge, in its units: keeps the information finite."""


@dataclass(frozen=True)
class MeasuredLink:
    """What tracking measured between a keyframe and the one before it, as an edge of the graph."""

    parent: int
    T_ab: Sim3
    information: Array
    """[7, 7]"""


def problem_of(
    numbers: Sequence[int],
    points: Mapping[int, AnchoredPoints],
    links: Mapping[int, MeasuredLink],
    poses: Sim3Batch,  # [K] of ``numbers``
    held: Mask,  # [K]
    folder: Path | None = None,
) -> JointProblem:
    """Everything that is known between the keyframes ``numbers``; ``folder`` as that of a
    :class:`JointProblem`."""
    place = {number: i for i, number in enumerate(numbers)}
    anchors = [points[number] for number in numbers if number in points]
    matches = MadeMatches([partial(_matches_of, each, place) for each in anchors])
    inside = [n for n in numbers if n in links and links[n].parent in place]
    return JointProblem(
        matches,
        [each.held_out for each in anchors],
        Links(
            np.array([place[n] for n in inside], dtype=np.intp),
            np.array([place[links[n].parent] for n in inside], dtype=np.intp),
            Sim3Batch.of([links[n].T_ab for n in inside] or [Sim3.identity()])[: len(inside)],
            np.array([links[n].information for n in inside]).reshape(-1, 7, 7),
        ),
        poses,
        ~held,
        folder,
    )


def _matches_of(points: AnchoredPoints, place: Mapping[int, int]) -> AnchorMatches:
    views = [number for number in sorted(points.seen) if number in place]
    at = np.zeros((len(views), len(points.rho), 2), np.float32)
    for i, number in enumerate(views):
        at[i] = points.seen[number]
    rho, variance = points.rho.astype(np.float64), points.variance.astype(np.float64)
    known = (rho > 1e-6) & (variance < (KNOWN_SIGMA * rho) ** 2)
    usual = float(np.median(rho[known])) if known.any() else 1.0
    return AnchorMatches(
        place[points.keyframe],
        np.array([place[number] for number in views], dtype=np.intp),
        points.rays,
        np.where(known, rho, usual),
        np.where(known, variance, np.inf),
        at,
        np.asarray(np.isfinite(at).all(axis=-1)),
        np.full(len(views), 1.0 / points.camera.fx),
    )


def improvement_of(
    snapshot: Snapshot,
    nodes: Index,  # [K] rows of the adjusted keyframes
    problem: JointProblem,
    adjusted: JointAdjustmentResult,
    certain: bool,
) -> Improvement:
    """The adjustment's poses, and the edges between them; ``certain``: with their covariance.

    Raises:
        numpy.linalg.LinAlgError: a pose is not determined at all.
    """
    place = np.full(len(snapshot.nodes), -1, dtype=np.intp)
    place[nodes] = np.arange(len(nodes))
    a, b = place[snapshot.edges["a"]], place[snapshot.edges["b"]]
    among = (a >= 0) & (b >= 0) & ~snapshot.edges["loop"]
    among[among] = _is_linked(a[among], b[among], problem.links)
    edges = np.flatnonzero(among)
    poses, moved = adjusted.state.poses, problem.free
    rows = snapshot.edges[edges]
    T_ab = (poses[a[edges]].inverse() @ poses[b[edges]]).on_group()
    write_poses(rows, slice(None), T_ab)
    if certain and len(edges):
        inverse = covariance(adjusted.matches, problem.links, adjusted.state, moved)
        order = np.where(moved, np.cumsum(moved) - 1, -1)
        for i, edge in enumerate(edges):
            spread = of_edge(inverse, order, int(a[edge]), int(b[edge]), T_ab[i : i + 1])
            spread = spread + LEAST_SIGMA**2 * np.eye(7)
            rows["covariance"][i], rows["information"][i] = spread, np.linalg.inv(spread)
    node_rows = snapshot.nodes[nodes[moved]]
    write_poses(node_rows, slice(None), poses[moved])
    return Improvement(nodes[moved], node_rows, edges, rows)


def _is_linked(
    a: Index,  # [m] places
    b: Index,  # [m]
    links: Links,
) -> Mask:
    """[m] the edges that are links of the problem."""
    known = set(zip(links.a.tolist(), links.b.tolist(), strict=True))
    pairs = zip(a.tolist(), b.tolist(), strict=True)
    return np.array([pair in known for pair in pairs], dtype=bool)


def poses_at(
    snapshot: Snapshot,
    nodes: Index,  # [K]
) -> Sim3Batch:
    """[K] poses in rows ``nodes`` [K] of a snapshot."""
    return poses_of(snapshot.nodes[nodes])


def copy(points: AnchoredPoints) -> AnchoredPoints:
    """A copy that another thread may add to; the arrays are shared, and never change."""
    return replace(points, seen=dict(points.seen))
