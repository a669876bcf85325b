"""A dive in its base: looks keyframes up, decides which links to believe, says where the dive lies.

Every keyframe is looked up once, and no frame waits for it. Few look-ups wait at a time: while they
do, further keyframes go without.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.base.worker import Worker
from aquaflow.config import TrackingConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes import KeyframeStore, Pointmap
from aquaflow.keyframes.place import NAME, KeyframePlace, KeypointDepths, PlacesFile, depths_at
from aquaflow.optimise.least_squares import NormalEquations, Rules, covariance_of, minimise
from aquaflow.optimise.robust import Huber
from aquaflow.prior.contract import Encoding
from aquaflow.telemetry.metric_file import map_name, read_main, read_metric_file
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.graph.table import Snapshot
from aquaflow.tracking.loops import Retrieval, Verified, verify_keypoints
from aquaflow.tracking.metric.measured import World, WorldEdge

STAGE = "look-up in the base"
"""Name of this work."""
MOST_WAITING = 3
"""Look-ups: as many keyframes as the start of a map makes at once."""
LEAST_AGREEING = 2
"""Keyframes that must put the dive at the same place before anything is believed."""
TO_OVERRULE = 3
"""Keyframes that must agree against those that are believed, and be more than they are."""
WAITING = 32
"""Recognitions that are kept while no other agrees with them."""


@dataclass(frozen=True)
class BaseLookup:
    """A keyframe that was looked up, and where it lies in the base, if it was recognised."""

    keyframe: int
    recognised: Recognised | None


@dataclass(frozen=True)
class FirstRecognised:
    """The moment at which the dive was found in the base."""

    frame: int
    t_ns: int
    """Of the keyframe whose recognition made it sure."""


class InBase:
    """To be used from the tracking thread."""

    def __init__(
        self,
        base: Base,
        keyframes: KeyframeStore,
        config: TrackingConfig,
        worker: Worker,
        failures: Failures,
    ) -> None:
        self.base = base
        self.links: list[BaseLink] = []
        """Those that are believed."""
        self.looked_up = self.passed_over = self.refused = 0
        """Keyframes: looked up; not, because others still were; recognised where the others
        say that they cannot be."""
        self.first: FirstRecognised | None = None
        self._places = KnownPlaces(base, config)
        self._keyframes, self._worker, self._failures = keyframes, worker, failures
        self._waiting: list[BaseLink] = []
        self._news = False
        self._placed: dict[int, SubMapInBase] | None = None

    @property
    def recognised(self) -> bool:
        """True once the dive, or a part of it, has a place in the base."""
        return bool(self.links)

    def look(self, number: int) -> None:
        """Look a new keyframe up."""
        if self._worker.waiting(STAGE) >= MOST_WAITING:
            self.passed_over += 1
            return
        keyframe = self._keyframes[number]
        with self._failures.contain(STAGE, keyframe.frame_index):
            encoding, pointmap = keyframe.encoding, keyframe.pointmap.copy()  # fused meanwhile
            self.looked_up += 1
            look_up = partial(self._look_up, number, encoding, pointmap)
            for found in self._worker.ask(STAGE, keyframe.frame_index, look_up):
                self.take(found)

    def _look_up(self, number: int, encoding: Encoding, pointmap: Pointmap) -> BaseLookup:
        return BaseLookup(number, self._places.of(encoding, pointmap))

    def has_news(self) -> bool:
        """True once after links were added: the graph should take them in."""
        news, self._news = self._news, False
        return news

    def follow_moves(self) -> None:
        """Keyframes have other poses or sub-maps than before."""
        self._placed = None

    def resume(
        self, links: Sequence[BaseLink], first: FirstRecognised | None, counts: Sequence[int]
    ) -> None:
        """Take up what an earlier run of the dive had found; ``counts``: of keyframes looked up,
        passed over and refused."""
        self.links, self.first = list(links), first
        self.looked_up, self.passed_over, self.refused = counts
        self._news, self._placed = bool(links), None

    # --- what is believed ---------------------------------------------------------------------

    def take(self, found: BaseLookup) -> None:
        """What a look-up found of a keyframe."""
        where = found.recognised
        if where is None:
            return
        known, covariance = where.place, link_covariance(where.proof.estimate.covariance)
        inliers = where.proof.inliers
        self.add(
            BaseLink(found.keyframe, known.number, known.sub_map, where.T_sk, covariance, inliers)
        )

    def add(self, link: BaseLink) -> None:
        """Believe a recognition if others agree with it; else keep it until one does."""
        near = self._nearest(link)
        if near is not None and self._agree(link, near):
            self._believe([link])
            return
        agreeing = [other for other in self._waiting if self._agree(link, other)]
        self._waiting = [*self._waiting, link][-WAITING:]
        self.refused += near is not None
        if near is None and len(agreeing) + 1 >= LEAST_AGREEING:
            self._believe([*agreeing, link])
        elif near is not None and len(agreeing) + 1 >= max(TO_OVERRULE, self._count(link) + 1):
            sub_map = self._keyframes[link.keyframe].sub_map
            self.links = [
                each for each in self.links if self._keyframes[each.keyframe].sub_map != sub_map
            ]
            self._believe([*agreeing, link])

    def _believe(self, links: Sequence[BaseLink]) -> None:
        if self.first is None:
            latest = self._keyframes[links[-1].keyframe]
            self.first = FirstRecognised(latest.frame_index, latest.t_ns)
        self.links = sorted([*self.links, *links], key=lambda link: link.keyframe)
        self._waiting = [each for each in self._waiting if each not in links]
        self._news, self._placed = True, None

    def _nearest(self, link: BaseLink) -> BaseLink | None:
        """Of the believed links of the same sub-map, the one nearest on the path."""
        sub_map = self._keyframes[link.keyframe].sub_map
        same = [each for each in self.links if self._keyframes[each.keyframe].sub_map == sub_map]
        return min(same, key=lambda each: abs(each.keyframe - link.keyframe), default=None)

    def _count(self, link: BaseLink) -> int:
        sub_map = self._keyframes[link.keyframe].sub_map
        return sum(self._keyframes[each.keyframe].sub_map == sub_map for each in self.links)

    def _agree(self, a: BaseLink, b: BaseLink) -> bool:
        at_a, at_b = self._keyframes[a.keyframe], self._keyframes[b.keyframe]
        if at_a.sub_map != at_b.sub_map or a.keyframe == b.keyframe:
            return False
        first, last = sorted((a.keyframe, b.keyframe))
        path = np.array([
            self._keyframes[number].T_wc.t
            for number in range(first, last + 1)
            if self._keyframes[number].sub_map == at_a.sub_map
        ])  # fmt: skip
        travelled = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        return agree(a, at_a.T_wc, b, at_b.T_wc, travelled / at_a.T_wc.scale)

    # --- what follows -------------------------------------------------------------------------

    def by_sub_map(self) -> dict[int, list[BaseLink]]:
        """The links of each sub-map of this dive: those to the part of the base that most lead
        to."""
        found: dict[int, list[BaseLink]] = {}
        for link in self.links:
            found.setdefault(self._keyframes[link.keyframe].sub_map, []).append(link)
        for sub_map, links in found.items():
            parts = [link.base_sub_map for link in links]
            most = max(sorted(set(parts)), key=parts.count)
            found[sub_map] = [link for link in links if link.base_sub_map == most]
        return found

    def places(self) -> Mapping[int, SubMapInBase]:
        """Where each sub-map that was recognised lies in the base."""
        if self._placed is None:
            self._placed = {
                sub_map: fit_sub_map(links, [self._keyframes[link.keyframe].T_wc for link in links])
                for sub_map, links in self.by_sub_map().items()
            }
        return self._placed

    def maps(self, sub_map: int) -> dict[Path, Sim3]:
        """The base's map files in which ``sub_map`` was recognised, the latest dive's first, each
        with T_mb from its world to the sub-map's; none while it was not."""
        where = self.places().get(sub_map)
        if where is None:
            return {}
        keyframes = {link.base_keyframe for link in self.by_sub_map()[sub_map]}
        T_ms = where.T_sm.inverse()
        found = map(self.base.map_of, sorted(keyframes, reverse=True))
        return {path: T_ms @ T_sb for path, T_sb in filter(None, found)}

    def frame(self, sub_map: int, own: WorldFrame) -> WorldFrame:
        """The base's frame with the place of ``sub_map`` in it; ``own``, by the dive's telemetry,
        where that was not recognised."""
        where = self.places().get(sub_map)
        if where is None:
            return own
        base = self.base.frame(self.by_sub_map()[sub_map][0].base_sub_map)
        carried = Sim3Batch.of([base.T_nm]).adjoint()[0]
        unit = base.scale_source if base.metric else "none: a map unit is that of the base"
        return replace(
            base,
            T_nm=base.T_nm @ where.T_sm,
            covariance=carried @ where.covariance @ carried.T + base.covariance,
            T_bc=own.T_bc,
            scale_source=f"{self.base.name}: {unit}" if base.metric else unit,
            sources=own.sources,
            site=self.base.name,
        )

    def worlds(self, snapshot: Snapshot) -> list[World]:
        """The base as a world of each component of the graph: read-only, for any thread."""
        component = dict(zip(snapshot.nodes["number"], snapshot.nodes["component"], strict=True))
        worlds, places = [], self.places()
        for sub_map, links in self.by_sub_map().items():
            edges = [
                WorldEdge(link.keyframe, link.T_sk, link.information, 0.0, 7)
                for link in links
                if link.keyframe in component
            ]
            if edges:
                T_ms = places[sub_map].T_sm.inverse()
                number = int(component[edges[0].keyframe])
                worlds.append(World(number, T_ms, edges, of_base=True))
        return worlds


# --------------------------------------------------------------------------------------------------
# Is this a place of the base? Retrieval among its keyframes, then the proof by geometry.
#
# Nothing of the new dive enters the index, and nothing of the base is tracked against: flow between
# pictures of two days, in other light and water, would not hold. Keypoints do.

CANDIDATES = 5
"""Keyframes of the base that one picture is compared with at most; the first that proves to show
it ends the search."""
LEAST_SIMILARITY = 0.01
"""Of a candidate: what chance gives. Other light and water cost most of the similarity that
neighbours of one dive have (0.02 to 0.08 are left), and the proof refuses what is elsewhere."""
KEPT = 32
"""Keyframes of the base whose keypoints stay in memory: 1.2 MB each at 2000 keypoints."""


@dataclass(frozen=True)
class Recognised:
    """A picture of this dive at a keyframe of the base."""

    place: KeyframePlace
    proof: Verified
    """``proof.estimate.T`` is T_kb, from the base's keyframe to this dive's, with scale."""

    @property
    def T_sk(self) -> Sim3:
        """This dive's keyframe in the world of the base's sub-map."""
        return self.place.T_mc @ self.proof.estimate.T.inverse()


class KnownPlaces:
    """The base's keyframes, to be asked from one thread."""

    def __init__(self, base: Base, config: TrackingConfig) -> None:
        """A keyframe that cannot be read is left out."""
        self._config = config.verification
        self._retrieval = Retrieval(config.retrieval)
        self._places: list[KeyframePlace] = []
        self.damaged = 0
        """Keyframes of the base that could not be read."""
        self._keypoints = lru_cache(KEPT)(base.keypoints)
        for place in base.places:
            try:
                self._retrieval.add(len(self._places), base.keypoints(place.number))
            except InputError:
                self.damaged += 1
            else:
                self._places.append(place)

    def of(self, encoding: Encoding, pointmap: Pointmap) -> Recognised | None:
        """The first keyframe of the base, most similar first, that proves to show this place."""
        found = self._retrieval.candidates(
            encoding, lambda _: False, CANDIDATES, least=LEAST_SIMILARITY
        )
        for candidate in found:
            place = self._places[candidate.number]
            try:
                past = self._keypoints(place.number)
            except InputError:
                continue  # damaged since
            own = depths_at(encoding.keypoints, pointmap)
            proof = verify_keypoints(past, own.keypoints, own.camera, self._config, own)
            if proof is not None:
                return Recognised(place, proof)
        return None


# --------------------------------------------------------------------------------------------------
# Recognitions as measurements: do two of them agree, and where do they put the dive?
#
# Each says where one keyframe lies in the base, as a Sim(3) with its information. A single one may
# be false, however many keypoints it has: places that look alike exist. Two that put the dive at
# the same place, turn and scale, within what the dive's own path may have drifted between them, are
# not false by chance.

Array = npt.NDArray[np.float64]

FLOOR = np.array([0.01, 0.01, 0.01, 0.003, 0.003, 0.003, 0.01])
"""1 sigma that a link has at least: translation in units of the keyframe (about its depth), rad,
log-scale. What a keyframe's depths have in common does not average out over its keypoints, and the
base has errors of its own: judgement, ten times what the pose solver states."""
DRIFT = np.array([0.03, 0.03, 0.03, 0.01, 0.01, 0.01, 0.02])
"""1 sigma of drift for each depth that the camera travelled: three times that of the worst shared
clip (notes/2026-11-benchmarks.md), because the base has drifted too."""
LARGEST_CHI2 = 24.3
"""Of seven numbers: chance exceeds it once in a thousand times."""
RULES = Rules(iterations=10, sigmas=1e-3, damping=0.0)
"""The links agree, so that three iterations are enough."""
KERNEL = Huber(3.0)
"""Of a link's seven numbers together."""


@dataclass(frozen=True)
class BaseLink:
    """A keyframe of this dive that was recognised in the base."""

    keyframe: int
    base_keyframe: int
    base_sub_map: int
    T_sk: Sim3
    """This dive's keyframe in the world of the base's sub-map."""
    covariance: Array
    """[7, 7] of the right tangent of ``T_sk``, :data:`FLOOR` included."""
    inliers: int
    """Keypoints that agree."""

    @property
    def information(self) -> Array:
        """[7, 7]"""
        return np.asarray(np.linalg.inv(self.covariance))


def link_covariance(
    covariance: Array,  # [7, 7] of the left tangent of T_kb, as the pose solver gives it
) -> Array:
    """[7, 7] of the right tangent of T_sk = T_sb T_kb^-1: the same but for its sign."""
    return np.asarray(covariance + np.diag(FLOOR**2))


def agree(a: BaseLink, T_ma: Sim3, b: BaseLink, T_mb: Sim3, travelled: float) -> bool:
    """True if two links put the dive at the same place.

    ``T_ma``, ``T_mb``: their keyframes in the dive's own world; ``travelled``: between them, in
    units of keyframe a.
    """
    if a.base_sub_map != b.base_sub_map:
        return False
    between = T_mb.inverse() @ T_ma
    apart = (a.T_sk.inverse() @ b.T_sk @ between).log()
    carried = Sim3Batch.of([between.inverse()]).adjoint()[0]
    drift = np.diag((DRIFT * travelled) ** 2)
    covariance = a.covariance + carried @ b.covariance @ carried.T + drift
    return bool(apart @ np.linalg.solve(covariance, apart) < LARGEST_CHI2)


@dataclass(frozen=True)
class SubMapInBase:
    """Where a sub-map of the dive lies in the base."""

    T_sm: Sim3
    covariance: Array
    """[7, 7] of its left tangent."""


def fit_sub_map(links: Sequence[BaseLink], poses: Sequence[Sim3]) -> SubMapInBase:
    """The similarity that fits all links best; ``poses``: T_mk of their keyframes, as they are now.

    Its covariance is that of the links, more where they scatter more than they state; links of
    neighbouring keyframes count as one half of a measurement each.
    """
    problem = _Placement(
        Sim3Batch.of([link.T_sk for link in links]),
        Sim3Batch.of(list(poses)),
        0.5 * np.stack([link.information for link in links]),
    )
    start = Sim3Batch.of([links[-1].T_sk @ poses[-1].inverse()])
    T_sm = minimise(problem, start, RULES).state
    size = problem.sizes(problem.residuals(T_sm))
    scatter = float((KERNEL.weight(size) * size**2).sum()) / max(7 * (len(links) - 1), 1)
    covariance = covariance_of(problem.linearise(T_sm).H)
    return SubMapInBase(T_sm.element(0), covariance * max(1.0, scatter))


@dataclass(frozen=True)
class _Placement:
    """Where a sub-map lies, by N links: a problem of least squares over one similarity."""

    T_sk: Sim3Batch
    """[N] measured"""
    T_mk: Sim3Batch
    """[N]"""
    information: Array
    """[N, 7, 7] of the right tangent."""

    def residuals(self, T_sm: Sim3Batch) -> Array:
        """[N, 7]"""
        return (self.T_sk.inverse() @ (T_sm @ self.T_mk)).log()

    def sizes(
        self,
        residuals: Array,  # [N, 7]
    ) -> Array:
        """[N] sigmas"""
        chi2 = np.einsum("ni,nij,nj->n", residuals, self.information, residuals)
        return np.asarray(np.sqrt(np.maximum(chi2, 0.0)))

    def linearise(self, T_sm: Sim3Batch) -> NormalEquations:
        """The equations of a step [7] of the left tangent."""
        residuals, J = self.residuals(T_sm), (T_sm @ self.T_mk).inverse().adjoint()
        weight = KERNEL.weight(self.sizes(residuals))[:, None, None]
        weighted = weight * (J.transpose(0, 2, 1) @ self.information)
        gradient = (weighted @ residuals[:, :, None]).sum(axis=0)[:, 0]
        return NormalEquations((weighted @ J).sum(axis=0), gradient, self.cost(T_sm))

    def cost(self, T_sm: Sim3Batch) -> float:
        """Huber's, of all links."""
        return float(KERNEL.cost(self.sizes(self.residuals(T_sm))).sum())

    def move(
        self,
        T_sm: Sim3Batch,
        step: Array,  # [P]
    ) -> Sim3Batch:
        """T_sm [1] after a step [7]."""
        return (Sim3Batch.exp(step[None]) @ T_sm).on_group()


# --------------------------------------------------------------------------------------------------
# An earlier dive as another one sees it: keyframes without pictures, read and never changed.


@dataclass(frozen=True)
class Base:
    """The places of an earlier dive, and where they are."""

    folder: Path
    prior: str
    """That described its keypoints; empty where that is not known."""
    places: Sequence[KeyframePlace]
    keypoints: Callable[[int], KeypointDepths]
    """Of a keyframe, by its number; raises InputError where they cannot be read."""
    frames: Mapping[int, WorldFrame]
    """By sub-map: where it lies in n, as the dive's files have it."""
    map_of: Callable[[int], tuple[Path, Sim3] | None] = lambda _: None
    """The map file that shows what a keyframe saw, and T_sb from its world to that of the
    keyframe's sub-map; None where there is no map. Later dives have higher numbers of keyframes."""

    @property
    def name(self) -> str:
        """Name of its folder."""
        return self.folder.resolve().name

    def frame(self, sub_map: int) -> WorldFrame:
        """The metric frame of a sub-map; the unknown one where there is none."""
        return self.frames.get(sub_map, WorldFrame.unknown())

    def refuse_other_prior(self, prior: str) -> None:
        """Check that its keypoints can be compared with those of ``prior``.

        Raises:
            InputError: another prior has described them.
        """
        if self.prior and self.prior != prior:
            raise InputError(
                f"the places of {self.folder} were described by the {self.prior} prior, this dive "
                f"has {prior}; map it with the same prior"
            )


# --------------------------------------------------------------------------------------------------
# Opens an earlier dive, or several in one frame, as the base of another dive.

METRICS = "metrics.json"
"""Says which prior the dive was tracked with."""
BASES = "aquaflow.bases"
"""Group of entry points: functions that open a folder of several dives, and return None for a
folder of another kind."""


def base_of(folder: Path) -> Base:
    """What an entry point of :data:`BASES` recognises in ``folder``, or the finished dive there.

    Raises:
        InputError: it is neither, or cannot be used.
    """
    for entry in entry_points(group=BASES):
        opened: Callable[[Path], Base | None] = entry.load()
        base = opened(folder)
        if base is not None:
            return base
    return open_base(folder)


def open_base(folder: Path) -> Base:
    """The finished dive in ``folder`` as a base; its keypoints stay in the file until asked for.

    Raises:
        InputError: it is no finished dive, has no places, or they cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give that of a finished dive to --in")
    refuse_unfinished(folder)
    if not (folder / NAME).is_file():
        raise InputError(
            f"{folder} has no {NAME}, by which places are found again; give a finished dive to "
            "--in, or map it again with this AquaFlow"
        )
    file = PlacesFile(folder / NAME)
    if not file.places:
        raise InputError(f"{folder / NAME} holds no place; give another dive to --in")
    sub_maps, main = {place.number: place.sub_map for place in file.places}, read_main(folder)

    @cache
    def map_of(number: int) -> tuple[Path, Sim3] | None:
        path = folder / map_name(sub_maps[number], main)
        return (path, Sim3.identity()) if path.is_file() else None

    return Base(
        folder, prior_of(folder), file.places, file.keypoints, read_metric_file(folder), map_of
    )


def prior_of(folder: Path) -> str:
    """The prior of a dive; empty where metrics.json is missing or damaged, which costs only the
    check that both dives have the same."""
    try:
        stated = read_regular_json(folder / METRICS)
        return str(stated.get("prior") or "")
    except (OSError, ValueError, AttributeError):
        return ""
