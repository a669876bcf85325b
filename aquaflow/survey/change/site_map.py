"""One map of a site: of every place the dive that shows it last, or more finely than the last.

Each dive's map stays what it is; the Gaussians of all are taken together, and where several dives
show a place, one of them counts:

- What a later dive's views see past is gone.
- Of dives that show a surface there the latest counts, unless an earlier one shows it in finer
  pixels: a look from afar, or in small pictures, does not replace a close one.
- Where no other dive looked, a dive's Gaussians stay.

Colours are without water, and every dive has its own light: those of earlier dives are multiplied
by one gain per channel, the median ratio over the ground that they share with later ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import PlyGaussians, read_ply
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.change.colour_change import DARKEST
from aquaflow.survey.change.surface import Progress, ViewLookup, look_at_places
from aquaflow.survey.export.mesh.view_surfaces import ViewSurfaces, surfaces_of_map
from aquaflow.survey.measure.drawn_heights import MATCH_PX
from aquaflow.survey.site.manifest import SiteDive, check_unchanged, read_site
from aquaflow.survey.site.merged_file import PlacedSubMap, merge_of
from aquaflow.survey.site.site_map_file import SiteMapPart, names_of, write_site_map

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MARGIN_RESOLUTIONS = 6.0
"""Distance across a surface up to which two dives show the same one, in resolutions of the coarser
map: 0.15 m where a picture shows 1.9 m. Dives of a merged site lie within some centimetres of each
other, and no finer than that is a thing gone, or new."""
FINER = 1.25
"""Ratio of the pixels' width on the ground from which an earlier dive counts before a later: more
than dives of one altitude and camera differ by, less than pictures of 320 and 480 px do."""
BLOCK_RANGES = 2.0
"""Side of the blocks that are looked at together, in median ranges of the views."""
OPAQUE = 0.5
"""Opacity from which a Gaussian's colour is compared."""
LEAST_PAIRS = 100
"""Gaussians in common from which a gain is taken: fewer could be one coral that grew."""


@dataclass(frozen=True)
class DayMap:
    """A dive's map in the site's world."""

    name: str
    gaussians: PlyGaussians
    """Colours without water."""
    views: ViewSurfaces

    @property
    def resolution(self) -> float:
        """Distance below which the map does not tell places apart."""
        return MATCH_PX * self.views.footprint


@dataclass(frozen=True)
class Part:
    """What the one map has of a dive."""

    name: str
    gaussians: PlyGaussians
    gone: int
    """Gaussians that later dives see past."""
    replaced: int
    """Gaussians of places that another dive shows later, or more finely."""
    gains: tuple[float, float, float]
    """That its colours were multiplied by."""

    def transform(self, T: Sim3) -> Part:
        """The same in the world that ``T`` maps to."""
        return replace(self, gaussians=self.gaussians.transform(T))


def combine(days: Sequence[DayMap]) -> list[Part]:
    """The parts of the one map, in the order of ``days``: the earliest first."""
    parts: list[Part] = []
    for number in reversed(range(len(days))):
        gone, replaced = _overrule(days, number)
        gains = _gains(days[number], replaced, parts)
        finite = np.isfinite(days[number].gaussians.means).all(axis=1)
        kept = days[number].gaussians.rows(finite & ~gone & ~replaced)
        kept = replace(kept, colours=(kept.colours * gains).astype(np.float32))
        counts = int(gone.sum()), int((replaced & ~gone).sum())
        red, green, blue = gains.tolist()
        parts.append(Part(days[number].name, kept, *counts, (red, green, blue)))
    return parts[::-1]


def _overrule(days: Sequence[DayMap], number: int) -> tuple[Mask, Mask]:
    """[N], [N] the Gaussians of a day that are gone, and those that another day shows."""
    day = days[number]
    places = np.asarray(day.gaussians.means, np.float64)
    gone, replaced = np.zeros(len(places), bool), np.zeros(len(places), bool)
    for block in _blocks(places, BLOCK_RANGES * day.views.median_range):
        own = _look(day, places[block], day.resolution)
        for other_number, other in enumerate(days):
            if other_number == number:
                continue
            seen = _look(other, places[block], max(day.resolution, other.resolution))
            if other_number > number:
                gone[block] |= seen.seen_past
                replaced[block] |= seen.shown & (seen.footprint < FINER * own.footprint)
            else:
                replaced[block] |= seen.shown & (FINER * seen.footprint <= own.footprint)
    return gone, replaced


def _look(
    day: DayMap,
    places: Array,  # [M, 3]
    resolution: float,
) -> ViewLookup:
    margin = np.full(len(places), MARGIN_RESOLUTIONS * resolution)
    return look_at_places(day.views, places, margin)


def _blocks(
    places: Array,  # [N, 3]
    side: float,
) -> Iterator[npt.NDArray[np.intp]]:
    """The numbers of the places in each cube of space that holds some."""
    finite = np.flatnonzero(np.isfinite(places).all(axis=1))
    cubes = np.floor(places[finite] / side).astype(np.int64)
    _, cube = np.unique(cubes, axis=0, return_inverse=True)
    order = np.argsort(cube, kind="stable")
    ends = np.flatnonzero(np.diff(cube[order])) + 1
    yield from (finite[block] for block in np.split(order, ends) if len(block))


def _gains(
    day: DayMap,
    replaced: Mask,  # [N] of the day's Gaussians
    later: Sequence[Part],
) -> Array:
    """[3] the ratio of the later dives' colours to the day's, on the ground that both show."""
    mine = np.flatnonzero(replaced & (np.asarray(day.gaussians.opacities) > OPAQUE))
    means = [part.gaussians.means[part.gaussians.opacities > OPAQUE] for part in later]
    colours = [part.gaussians.colours[part.gaussians.opacities > OPAQUE] for part in later]
    if len(mine) == 0 or sum(map(len, means)) == 0:
        return np.ones(3)
    away, nearest = cKDTree(np.concatenate(means)).query(
        day.gaussians.means[mine], distance_upper_bound=MARGIN_RESOLUTIONS * day.resolution
    )
    near = np.isfinite(away)
    theirs = np.concatenate(colours)[np.asarray(nearest)[near]].astype(np.float64)
    own = day.gaussians.colours[mine[near]].astype(np.float64)
    lit = (theirs > DARKEST).all(axis=1) & (own > DARKEST).all(axis=1)
    if lit.sum() < LEAST_PAIRS:
        return np.ones(3)
    return np.asarray(np.median(theirs[lit] / own[lit], axis=0))


# --------------------------------------------------------------------------------------------------
# ``aquaflow site map``: reads the merged dives of a site, and writes their one map.


@dataclass(frozen=True)
class PlacedDive:
    """A dive of the component that the map is of."""

    folder: Path
    sub_map: PlacedSubMap
    """Its largest, whose map counts."""


@dataclass(frozen=True)
class MadeMap:
    """What was written."""

    ply: Path
    parts: list[SiteMapPart]
    left_out: dict[str, str]
    """Dives of the component that have no part in it: name and reason."""


def make_site_map(site: Path, component: int | None, work: Path, progress: Progress) -> MadeMap:
    """Write the one map of a component, by default of the one with most keyframes.

    A dive that was added to the site later counts as the later one; one that has no map, or is not
    what was merged, is left out.

    Args:
        work: folder of files that end with the call.

    Raises:
        InputError: the site was never merged, none of the dives is left, or the site cannot be
            written to.
    """
    dives = ComponentDives(site, component)
    return dives.write(combine(dives.each(partial(_day, work=work, progress=progress))))


Made = TypeVar("Made")


class ComponentDives:
    """The dives of a component of a site that have a part in its map."""

    def __init__(self, site: Path, component: int | None) -> None:
        """None: the component with most keyframes.

        Raises:
            InputError: the site was never merged, or has no such component.
        """
        self.merged = merge_of(site)
        self._site, self._number = site, self.merged.choose(component, site)
        self.placed: list[PlacedDive] = []
        """In the order of the site, the earliest first."""
        self._left_out: dict[str, str] = {}
        for dive in read_site(site):
            if dive.name in self.merged.fingerprints:
                with self._leaving_out(dive.name):
                    self._place(dive)

    def _place(self, dive: SiteDive) -> None:
        main = self.merged.main_of(dive, self._site)
        if main is not None and main.component == self._number:
            folder = dive.folder(self._site)
            check_unchanged(folder, self.merged.fingerprints[dive.name])
            self.placed.append(PlacedDive(folder, main))

    @contextmanager
    def _leaving_out(self, name: str) -> Iterator[None]:
        try:
            yield
        except AquaFlowError as error:
            self._left_out[name] = str(error)

    def each(self, make: Callable[[PlacedDive], Made]) -> list[Made]:
        """What is made of each dive; one for which that raises is left out.

        Raises:
            InputError: none is left.
        """
        placed, made = self.placed, list[Made]()
        self.placed = []
        for dive in placed:
            with self._leaving_out(dive.sub_map.dive):
                made.append(make(dive))
                self.placed.append(dive)
        if not made:
            reasons = "; ".join(self._left_out.values()) or "no dive has its map there"
            raise InputError(
                f"component {self._number} of {self._site} has nothing to make a map of: {reasons}"
            )
        return made

    def write(self, parts: Sequence[Part]) -> MadeMap:
        """Write the one map of ``parts``, one of each dive.

        Raises:
            InputError: a file cannot be written.
        """
        stated = [
            _site_map_part(part, each.sub_map, self.merged.fingerprints[each.sub_map.dive])
            for part, each in zip(parts, self.placed, strict=True)
        ]
        write_site_map(self._site, self._number, stated, [part.gaussians for part in parts])
        return MadeMap(names_of(self._site, self._number)[0], stated, self._left_out)


def _day(each: PlacedDive, work: Path, progress: Progress) -> DayMap:
    dive, placed = Dive(each.folder), each.sub_map
    mapper = dive.filled_map()
    views = surfaces_of_map(mapper, placed.T_sm, work, partial(progress, f"views of {placed.dive}"))
    ply = "map_clear.ply" if dive.has("map_clear.ply") else "map.ply"
    gaussians = read_ply(dive.file(ply))
    return DayMap(placed.dive, gaussians.transform(placed.T_sn), views)


def _site_map_part(part: Part, placed: PlacedSubMap, fingerprint: str) -> SiteMapPart:
    return SiteMapPart(
        part.name, fingerprint, placed.T_sn.matrix.tolist(), len(part.gaussians.means),
        part.gone, part.replaced, list(part.gains),
    )  # fmt: skip
