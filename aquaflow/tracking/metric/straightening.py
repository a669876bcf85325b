"""The keyframe graph solved with telemetry, learned scales and known lengths: sub-maps' worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import hypot, isfinite

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.config.tracking import LearnedConfig
from aquaflow.geometry.arrays import to_sim3
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes import KeyframeStore, Pointmap
from aquaflow.optimise.robust import sigma_of
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.dead_reckoning import carried_from
from aquaflow.telemetry.estimator import Estimate, estimate
from aquaflow.telemetry.factors import length_factors
from aquaflow.telemetry.known_lengths.board_size import BoardView, PixelDepths
from aquaflow.telemetry.known_lengths.finder import KnownLengthFinder
from aquaflow.telemetry.known_lengths.known_length import KnownLength
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import SourceReport, WorldFrame
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.graph.optimisation import Optimisation
from aquaflow.tracking.graph.table import EDGE, NODE, TRUST, GraphResult, Snapshot
from aquaflow.tracking.metric.measured import (
    KeyframeMeasurements,
    World,
    WorldEdge,
    world_edge,
    world_edges,
)


def estimates_of(survey: TrackingSnapshot) -> dict[int, Estimate]:
    """The metric frame of every component of the graph, by its first keyframe."""
    found: dict[int, Estimate] = {}
    before: tuple[Estimate, CameraPath] | None = None
    measured = survey.known_lengths()
    for component in survey.components():
        path = survey.path(component)
        carried = None
        if before is not None:
            carried = carried_from(*before, survey.telemetry, path)
        known = measured.get(component, SeenLengths([], []))
        found[component] = estimate(
            survey.telemetry, path, survey.config, survey.mounting,
            partial(survey.ground, component), length_factors(known.lengths), carried,
        ).reporting(known.unknown)  # fmt: skip
        if found[component].frame.metric:
            before = found[component], path
    return found


STRAIN = 1.5
"""Mean squared difference of path and telemetry, in sigmas, up to which a sub-map stays as it is:
the camera alone is more precise than any instrument where nothing has drifted."""
TREND_SIGMAS = 4.0
"""Of the slope of the measured scale along the dive, from which a sub-map is straightened though
single keyframes agree: 0.1 % a second for 90 s with a DVL has a strain of 0.4 to 0.8."""
LINK_TURN = np.radians(0.05)
"""rad, 1 sigma: links of a synthetic forward view of 164 keyframes turn by 0.02 to 0.08 degrees too
much, root mean square, and mostly the same way; the pose solver's own sigma is 0.01."""
LINK_SHIFT = 0.003
"""1 sigma of a link's translation, over its length, likewise."""


@dataclass(frozen=True)
class Straightened:
    """Keyframes as loops and telemetry want them, and the worlds that they lie in then."""

    result: GraphResult
    frames: dict[int, WorldFrame]
    """By component."""
    strained: bool
    """True if keyframes were pulled to a world; False if they are where they would be without."""
    worlds: tuple[World, ...] = ()
    """Those of telemetry that keyframes were pulled to."""

    def fits(self, snapshot: Snapshot) -> bool:
        """True if the graph has the same sub-maps as when telemetry was asked."""
        return set(np.unique(snapshot.nodes["component"]).tolist()) == self.frames.keys()


def straighten(
    snapshot: Snapshot,
    survey: TrackingSnapshot,
    t_s: Mapping[int, float],
    bases: Sequence[World] = (),
) -> Straightened:
    """Optimise a snapshot together with what telemetry says of its keyframes.

    ``t_s``: moment of each keyframe, by number; ``bases``: worlds of an earlier dive, in which
    keyframes were recognised. Reads nothing else, and changes nothing.
    """
    nodes, worlds = snapshot.nodes, list[World]()
    estimates = estimates_of(survey)
    for component, found in estimates.items():
        inside = nodes[nodes["component"] == component]
        numbers = inside["number"]
        moments = np.array([t_s[number] for number in numbers.tolist()])
        edges = world_edges(found, numbers, moments, poses_of(inside))
        world = World.at(component, found.frame, edges)
        if world.strain > STRAIN or world.scale_trend_sigmas > TREND_SIGMAS:
            worlds.append(world)
    frames = {component: found.frame for component, found in estimates.items()}
    return _solved(snapshot, frames, worlds, bases)


def straighten_again(
    snapshot: Snapshot, before: Straightened, bases: Sequence[World] = ()
) -> Straightened:
    """Optimise a snapshot with what telemetry said when it was asked ``before``: of the keyframes
    since then it says nothing. Takes a fraction of :func:`straighten`'s time, which grows with the
    whole dive."""
    return _solved(snapshot, before.frames, before.worlds, bases)


def _solved(
    snapshot: Snapshot,
    frames: Mapping[int, WorldFrame],
    worlds: Sequence[World],
    bases: Sequence[World],
) -> Straightened:
    pulling = [*bases, *worlds]
    result, T_mn = solve_with_worlds(snapshot, pulling)
    found = dict(frames)
    for component, T in T_mn.items():
        if found[component].metric:
            found[component] = replace(found[component], T_nm=T.inverse())
    kept = tuple(replace(world, T_mn=T_mn[world.component]) for world in worlds)
    return Straightened(result, found, bool(pulling), kept)


def solve_with_worlds(
    snapshot: Snapshot, worlds: list[World]
) -> tuple[GraphResult, dict[int, Sim3]]:
    """Optimise keyframes and worlds: the result of the keyframes alone, and T_mn by component."""
    if not worlds:
        return Optimisation(snapshot, everything=False).run(), {}
    edges, count = len(snapshot.edges), len(snapshot.nodes)
    result = Optimisation(_with_worlds(snapshot, worlds), everything=False).run()
    own = result.rows < count
    T_mn = {
        world.component: result.poses.get(world.number, world.T_mn)
        for world in worlds
        if not world.of_base
    }
    poses = {number: T for number, T in result.poses.items() if number >= 0}
    keyframes = replace(
        result,
        poses=poses,
        trust={edge: trust for edge, trust in result.trust.items() if edge < edges},
        snapshot=snapshot,
        rows=result.rows[own],
        solved=result.solved[own],
        edge_trust=result.edge_trust[:edges],
    )
    return keyframes, T_mn


def _with_worlds(snapshot: Snapshot, worlds: list[World]) -> Snapshot:
    """The snapshot with a node for every world, whose number is negative, and its edges."""
    row = {int(number): i for i, number in enumerate(snapshot.nodes["number"])}
    nodes = np.zeros(len(worlds), NODE)
    edges = np.zeros(sum(len(world.edges) for world in worlds), EDGE)
    k = 0
    for i, world in enumerate(worlds):
        T = world.T_mn
        nodes[i] = (world.number, world.component, T.R, T.t, T.scale)
        for edge in world.edges:
            edges[k]["a"], edges[k]["b"] = len(snapshot.nodes) + i, row[edge.keyframe]
            edges[k]["R"], edges[k]["t"], edges[k]["scale"] = (
                edge.T_nk.R,
                edge.T_nk.t,
                edge.T_nk.scale,
            )
            edges[k]["information"] = edge.information
            k += 1
    trust = np.zeros(len(edges), TRUST)
    trust["trust"], trust["allowed"] = 1.0, snapshot.config.loop_chi2
    return replace(
        snapshot,
        nodes=_join(snapshot.nodes, nodes),
        edges=_join(_soften(snapshot.edges) if worlds else snapshot.edges, edges),
        trust=_join(snapshot.trust, trust),
    )


def _soften(
    edges: Rows,  # [M] EDGE
) -> Rows:
    """A copy in which links along the path have the sigmas that they have against the truth."""
    links = ~edges["loop"]
    size = np.linalg.norm(edges["t"][links], axis=1)[:, None]
    least = np.hstack(
        [np.tile(LINK_SHIFT * size, 3), np.full((len(size), 3), LINK_TURN), 0.0 * size]
    )
    soft = edges.copy()
    covariance = edges["covariance"][links] + least[:, :, None] ** 2 * np.eye(7)
    soft["covariance"][links], soft["information"][links] = covariance, np.linalg.inv(covariance)
    return soft


def _join(
    first: Rows,  # [n]
    second: Rows,  # [m] of the same dtype
) -> Rows:
    return np.concatenate([first, second])


# --------------------------------------------------------------------------------------------------
# A learned prior against drift of scale: its unit is the same from the first picture to the last.
#
# The unit of a keyframe's depths drifts along a dive by a little at every link. A network errs by
# much more, but one whose unit is the same everywhere by as much in the last picture as in the
# first. So what it says of the unit of every keyframe is an edge to a world whose unit is the
# network's (``world_edges``), with the error that the differences between keyframes a few links
# apart show. Only a drift beyond that error moves anything; where telemetry knows the scale, the
# network is not asked.

Array = npt.NDArray[np.float64]

LEAST_KEYFRAMES = 20
"""Of a component, before which its scales are too few to tell drift from error."""
EVERY = 10
"""Keyframes between two looks at the scales."""
APART = 5
"""Keyframes whose scales are compared: nearer ones show the same scene, and the network errs alike;
a drift of a percent a link changes the median of the differences and not their spread."""
"""Mean squared difference of the scales, in sigmas, up to which they stay as they are
(``straightening``)."""
HELD = 1e-3
"""rad, and units of the first keyframe, that it is held to: the network knows no place."""


@dataclass(frozen=True)
class _Scales:
    """What the network says of the scales of one component."""

    rows: npt.NDArray[np.intp]
    """[K] of the snapshot's nodes"""
    excess: Array
    """[K] logarithm of the component's unit over the network's, by each keyframe"""
    sigma: Array
    """[K]"""

    @property
    def middle(self) -> float:
        """Logarithm of the component's unit over the network's."""
        return float(np.median(self.excess))

    @property
    def strain(self) -> float:
        """Mean squared difference from the median, in sigmas: 1 without drift."""
        return float((((self.excess - self.middle) / self.sigma) ** 2).mean())


class LearnedScales:
    """Takes part in the graph's optimisations, as telemetry does."""

    def __init__(self, keyframes: KeyframeStore, unit_sigma: float) -> None:
        """Scales of keyframes whose pointmaps say what the network's unit is; ``unit_sigma`` is
        what that may differ by from one part of a dive to another (`Prior.unit_sigma`)."""
        self._keyframes, self._unit_sigma = keyframes, unit_sigma
        self._known: dict[int, tuple[float, float]] = {}
        """By keyframe: logarithm of its unit over the network's, and 1 sigma."""
        self._since = 0

    @property
    def present(self) -> bool:
        """True once enough keyframes have a scale."""
        return len(self._known) >= LEAST_KEYFRAMES

    def keyframe(self, number: int, parent: int | None) -> bool:
        """A new keyframe; True if it is time to look at the scales."""
        found = self._keyframes[number].pointmap.learned
        if found is not None:
            self._known[number] = found.log_scale, found.log_scale_sigma
        self._since += 1
        if self._since < EVERY or not self.present:
            return False
        self._since = 0
        return True

    def job(self, snapshot: Snapshot) -> Callable[[Snapshot], GraphResult]:
        """The optimisation of a snapshot with the scales, to be called in any thread."""
        known = {n: (log, hypot(s, self._unit_sigma)) for n, (log, s) in self._known.items()}
        return lambda better: solve_with_worlds(better, worlds_of(better, known))[0]

    def apply(self) -> None:
        """Nothing is kept of a result."""


def learned_scales(
    keyframes: KeyframeStore, unit_sigma: float, config: LearnedConfig
) -> LearnedScales | None:
    """None where they are not wanted, or the network has no unit that lasts."""
    return LearnedScales(keyframes, unit_sigma) if config.scale and isfinite(unit_sigma) else None


def worlds_of(
    snapshot: Snapshot,
    known: dict[int, tuple[float, float]],
) -> list[World]:
    """The world of each component whose scales have drifted by more than the network errs."""
    worlds = []
    for component in np.unique(snapshot.nodes["component"]).tolist():
        scales = _scales(snapshot.nodes, component, known)
        if scales is not None and scales.strain > STRAIN:
            worlds.append(_world(snapshot.nodes, component, scales))
    return worlds


def _scales(
    nodes: Rows,  # [N] NODE
    component: int,
    known: dict[int, tuple[float, float]],
) -> _Scales | None:
    inside = np.flatnonzero(nodes["component"] == component)
    inside = inside[np.argsort(nodes["number"][inside])]
    rows = np.array([row for row in inside if int(nodes["number"][row]) in known], dtype=np.intp)
    if len(rows) < LEAST_KEYFRAMES:
        return None
    found = np.array([known[int(number)] for number in nodes["number"][rows]])
    excess = np.log(nodes["scale"][rows]) + found[:, 0]
    change = excess[APART:] - excess[:-APART]
    spread = sigma_of(change - np.median(change)) / 2.0**0.5
    return _Scales(rows, excess, np.hypot(found[:, 1], spread))


def _world(
    nodes: Rows,  # [N] NODE
    component: int,
    scales: _Scales,
) -> World:
    """Its edges say the scale of every keyframe, and where the first is."""
    T_mn = Sim3(np.eye(3), np.zeros(3), float(np.exp(scales.middle)))
    to_n = Sim3Batch.of([T_mn.inverse()])
    edges: list[WorldEdge] = []
    first = int(np.flatnonzero(nodes["number"] == component)[0])
    T_first = (to_n @ poses_of(nodes[first : first + 1])).element(0)
    held = HELD * T_first.scale
    gauge = KeyframeMeasurements(
        depth_m=(float(T_first.t[2]), held),
        place_m=(T_first.t[:2], held),
        turn=np.zeros(3),
        turn_sigma=(HELD, HELD),
    )
    edge = world_edge(component, T_first, gauge)
    edges += [] if edge is None else [edge]
    T_nk = to_n @ poses_of(nodes[scales.rows])
    for k, row in enumerate(scales.rows.tolist()):
        T, excess = T_nk.element(k), scales.excess[k] - scales.middle
        measured = KeyframeMeasurements(
            scale=(T.scale * float(np.exp(-excess)), float(scales.sigma[k]))
        )
        edge = world_edge(int(nodes["number"][row]), T, measured)
        edges += [] if edge is None else [edge]
    return World(component, T_mn, edges)


# --------------------------------------------------------------------------------------------------
# What the estimator needs of a dive at one moment, so that another thread may work on it.

POINTS_OF_KEYFRAME = 600
"""Of each pointmap, for the altimeter's beam."""
MOST_POINTS = 300_000
"""Of a sub-map; a beam looks through all of them."""
KNOWN_SIGMA = 0.1
"""Relative 1 sigma of a pixel's depth that counts as ground."""


@dataclass(frozen=True)
class TrackingSnapshot:
    """Read-only: keyframes and frames as they are now, and all telemetry until now."""

    nodes: Rows
    """[K] NODE of the keyframe graph."""
    parts: Sequence[Rows]
    """[n] FRAME: finished frames, in pieces."""
    telemetry: Telemetry
    points: Sequence[Array]
    """[n, 3] of each keyframe by its number, in its own camera frame; empty for some."""
    mounting: MountingConfig | None
    config: FusionConfig
    sightings: LengthSightings

    @cached_property
    def frames(self) -> Rows:
        """[N] FRAME: the same in one piece, put together by the thread that works on them."""
        return np.concatenate(self.parts)

    def components(self) -> list[int]:
        """Sub-maps in the order of their first keyframe, by its number."""
        return [int(number) for number in np.unique(self.nodes["component"])]

    def path(self, component: int) -> CameraPath:
        """The camera's path in a sub-map."""
        row = np.full(int(self.nodes["number"].max(initial=-1)) + 1, -1)
        inside = np.flatnonzero(self.nodes["component"] == component)
        row[self.nodes["number"][inside]] = inside
        posed = self.frames[self.frames["keyframe"] >= 0]
        posed = posed[posed["keyframe"] < len(row)]
        at = row[posed["keyframe"]]
        posed, at = posed[at >= 0], at[at >= 0]
        order = np.argsort(posed["t_ns"], kind="stable")
        posed, at = posed[order], at[order]
        if len(posed) == 0:
            return CameraPath(np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        T_mc = poses_of(self.nodes[at]) @ _similarities(posed["T_kf"])
        t_s, first = np.unique(posed["t_ns"] * 1e-9, return_index=True)
        return CameraPath(t_s, T_mc.R[first], T_mc.t[first])

    def known_lengths(self) -> dict[int, SeenLengths]:
        """What was seen of known size, by component, measured with the poses of now."""
        if not self.sightings:
            return {}
        node = {int(number): row for row, number in enumerate(self.nodes["number"].tolist())}
        frame = {int(index): row for row, index in enumerate(self.frames["index"].tolist())}

        def place_of(frame_index: int) -> tuple[Sim3, int] | None:
            row = self.frames[frame[frame_index]] if frame_index in frame else None
            at = None if row is None else node.get(int(row["keyframe"]))
            if row is None or at is None:
                return None
            T_mk, T_kf = poses_of(self.nodes[at : at + 1]), to_sim3(row["T_kf"])
            return T_mk.element(0) @ T_kf, int(self.nodes["component"][at])

        return self.sightings.measure(place_of)

    def ground(self, component: int) -> Array:
        """[K, 3] points of a sub-map, in its world."""
        inside = self.nodes[self.nodes["component"] == component]
        T_mk = poses_of(inside)
        clouds = [
            T_mk.element(i).apply(self.points[number])
            for i, number in enumerate(inside["number"].tolist())
            if number < len(self.points) and len(self.points[number])
        ]
        cloud = np.concatenate([np.zeros((0, 3)), *clouds])
        return cloud[:: max(1, -(-len(cloud) // MOST_POINTS))]


def sampled_points(pointmap: Pointmap) -> Array:
    """[n, 3] well-known points of a keyframe, evenly over its picture, in its camera frame."""
    known = np.argwhere(pointmap.is_known(KNOWN_SIGMA))
    chosen = known[:: max(1, -(-len(known) // POINTS_OF_KEYFRAME))]
    if len(chosen) == 0:
        return np.zeros((0, 3))
    pixels = chosen[:, ::-1] + 0.5
    rays = pointmap.camera.unproject(pixels)
    return np.asarray(rays / pointmap.rho[chosen[:, 0], chosen[:, 1]][:, None])


def _similarities(
    rows: Array,  # [N, 13] as of storage.arrays.of_sim3
) -> Sim3Batch:
    return Sim3Batch(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:12], rows[:, 12])


# --------------------------------------------------------------------------------------------------
# Where objects of known size were seen in a dive, with what measuring them in the map needs.

PlaceOf = Callable[[int], tuple[Sim3, int] | None]
"""T_wc and the component of a frame by its index; None for a frame without a pose."""


@dataclass(frozen=True)
class SeenLengths:
    """Objects of known size in one sub-map."""

    lengths: list[KnownLength]
    unknown: list[SourceReport]
    """Of objects that were seen, but could not be measured."""


class LengthSightings:
    """Grows with the pictures; a kilobyte for each that shows something."""

    def __init__(self, config: FusionConfig) -> None:
        self.looks_for = bool(config.enabled and (config.boards or config.lasers))
        """True if the settings name an object."""
        self._finder = KnownLengthFinder(config)
        self._cameras: dict[int, CameraModel] = {}
        self._pixels: dict[int, Array] = {}
        self._depths: dict[int, PixelDepths] = {}

    def __bool__(self) -> bool:
        return bool(self._finder)

    def look(
        self,
        frame_index: int,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB, undistorted
        camera: CameraModel,
    ) -> None:
        """Look for the objects in a picture: some milliseconds for each."""
        pixels = self._finder.look(frame_index, image)
        if len(pixels):
            self._cameras[frame_index], self._pixels[frame_index] = camera, pixels

    def keep_depths(self, frame_index: int, pointmap: Callable[[], Pointmap]) -> None:
        """Keep a keyframe's depths where something was seen in it."""
        pixels = self._pixels.get(frame_index)
        if pixels is not None:
            found = pointmap()
            view = BoardView(found.camera, Sim3.identity(), 0, found.rho, found.variance)
            self._depths[frame_index] = PixelDepths(pixels, *view.depth_at(pixels))

    def copy(self) -> LengthSightings:
        """What was seen until now, to be measured by another thread."""
        other = copy(self)
        other._finder = self._finder.copy()
        other._cameras, other._depths = dict(self._cameras), dict(self._depths)
        return other

    def measure(self, place_of: PlaceOf) -> dict[int, SeenLengths]:
        """What was seen, by component, measured with the poses of now."""

        def view_of(frame_index: int) -> BoardView | None:
            place, camera = place_of(frame_index), self._cameras.get(frame_index)
            if place is None or camera is None:
                return None
            return BoardView(camera, *place, depths=self._depths.get(frame_index))

        lengths = self._finder.lengths(view_of)
        known = {(length.sub_map, length.source) for length in lengths}
        seen = self._finder.count_seen(view_of)
        found = {component: SeenLengths([], []) for component, _ in seen}
        for length in lengths:
            found[length.sub_map].lengths.append(length)
        for (component, name), pictures in seen.items():
            if (component, name) not in known:
                reason = f"its size does not follow from the pictures that show it ({pictures})"
                found[component].unknown.append(SourceReport(name, "length", reason=reason))
        return found
