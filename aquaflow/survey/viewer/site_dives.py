"""The dives of a merged site that are shown together: those of one component, in its world."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.site.frames import frame_of
from aquaflow.survey.site.manifest import SiteDive, check_unchanged, read_site
from aquaflow.survey.site.merged_file import MergedSite, PlacedSubMap, merge_of
from aquaflow.survey.site.site_map_file import SiteMapPart, parts_of
from aquaflow.survey.site.site_paths import sub_maps_of_frames
from aquaflow.survey.viewer.dive_path import DivePath
from aquaflow.survey.viewer.finished import FinishedDive, finished_dive
from aquaflow.telemetry.world_frame import WorldFrame

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlacedDive:
    """A dive where the merge has put it."""

    name: str
    """In the site."""
    dive: FinishedDive
    T_sn: Sim3
    """From the world of the dive's ``map.ply``."""
    path: DivePath
    """T_sc: of the frames whose sub-maps are in the component."""


@dataclass(frozen=True)
class ShownSite:
    """What the viewer shows of a site."""

    folder: Path
    component: int
    components: int
    """How many there are."""
    dives: tuple[PlacedDive, ...]
    frame: WorldFrame
    left_out: Mapping[str, str]
    """Dives of the component that cannot be shown: name and reason."""
    one_map: list[SiteMapPart] | None
    """What that of ``aquaflow site map`` is made of, where it is of these dives as they lie now."""


def read_shown(site: Path, component: int | None, budget: int) -> ShownSite:
    """The dives of a component, by default of the one with most keyframes.

    Raises:
        InputError: there is no merged site, no such component, or no dive of it that is as it was.
    """
    merged = merge_of(site)
    chosen = merged.choose(component, site)
    dives = {dive.name: dive for dive in read_site(site)}
    shown, left_out = [], {}
    for name, before in merged.fingerprints.items():
        placed = [each for each in merged.of_dive(name) if each.component == chosen]
        if not placed:
            continue
        try:
            shown.append(_place(site, merged, dives.get(name), name, before, placed, budget))
        except InputError as error:
            log.warning("%s is not shown: %s", name, error)
            left_out[name] = str(error)
    if not shown:
        reasons = "; ".join(left_out.values())
        raise InputError(
            f"no dive of component {chosen} of {site} can be shown: {reasons}; run `aquaflow site "
            f"merge {site}` again"
        )
    folders = {name: dive.folder(site) for name, dive in dives.items()}
    frame = frame_of(merged.components[chosen], folders)
    T_sn = {placed.name: placed.T_sn for placed in shown}
    one_map = None
    try:
        one_map = parts_of(site, chosen, merged.fingerprints, T_sn)
    except InputError as error:
        log.warning("the dives' own maps are shown: %s", error)
    return ShownSite(site, chosen, len(merged.components), tuple(shown), frame, left_out, one_map)


def _place(
    site: Path,
    merged: MergedSite,
    dive: SiteDive | None,
    name: str,
    before: str,
    placed: Sequence[PlacedSubMap],
    budget: int,
) -> PlacedDive:
    if dive is None:
        raise InputError(f"{name} is no longer a dive of {site}")
    folder = dive.folder(site)
    check_unchanged(folder, before)
    main = merged.main_of(dive, site)
    if main is None or main not in placed:
        raise InputError(f"the map of {name} is of a sub-map that is not in this component")
    read = Dive(folder)
    shown = finished_dive(read, budget)
    path = _move(shown.path, sub_maps_of_frames(read), placed)
    return PlacedDive(name, shown, main.T_sn, path)


def _move(path: DivePath, sub_maps: Mapping[int, int], placed: Sequence[PlacedSubMap]) -> DivePath:
    """``sub_maps``: by the microsecond of a frame."""
    T_sn = {each.number: each.T_sn for each in placed}
    inside, poses = [], []
    for i, (t_s, T_nc) in enumerate(zip(path.t_s, path.poses, strict=True)):
        number = sub_maps.get(round(float(t_s) * 1e6))
        if number in T_sn:
            T_sc = T_sn[number] @ T_nc
            inside.append(i)
            poses.append(Sim3(T_sc.R, T_sc.t))
    return replace(path.among(inside), poses=poses)
