"""``aquaflow site map``: reads the merged dives of a site, and writes their one map."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import read_ply
from aquaflow.survey.change.site_map import DayMap, Part, combine
from aquaflow.survey.change.surface import Progress
from aquaflow.survey.export.mesh.view_surfaces import surfaces_of_map
from aquaflow.survey.site.manifest import check_unchanged, read_site
from aquaflow.survey.site.merged_file import PlacedSubMap, merge_of
from aquaflow.survey.site.site_map_file import SiteMapPart, names_of, write_site_map


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
    merged = merge_of(site)
    chosen = merged.choose(component, site)
    days, placed = [], []
    left_out: dict[str, str] = {}
    for dive in read_site(site):
        if dive.name not in merged.fingerprints:
            continue
        try:
            main = merged.main_of(dive, site)
            if main is None or main.component != chosen:
                continue
            folder = dive.folder(site)
            check_unchanged(folder, merged.fingerprints[dive.name])
            days.append(_day(folder, main, work, progress))
            placed.append(main)
        except AquaFlowError as error:
            left_out[dive.name] = str(error)
    if not days:
        reasons = "; ".join(left_out.values()) or "no dive has its map there"
        raise InputError(f"component {chosen} of {site} has nothing to make a map of: {reasons}")
    parts = combine(days)
    stated = [
        _site_map_part(part, main, merged.fingerprints[main.dive])
        for part, main in zip(parts, placed, strict=True)
    ]
    write_site_map(site, chosen, stated, [part.gaussians for part in parts])
    return MadeMap(names_of(site, chosen)[0], stated, left_out)


def _day(folder: Path, placed: PlacedSubMap, work: Path, progress: Progress) -> DayMap:
    dive = Dive(folder)
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
