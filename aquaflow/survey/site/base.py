"""A merged site as the base in which another dive is looked for."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cache
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import KeyframePlace, KeypointDepths, PlacesFile
from aquaflow.survey.site.frames import frame_of
from aquaflow.survey.site.manifest import check_unchanged, is_site, read_site
from aquaflow.survey.site.merged_file import MergedSite, merge_of
from aquaflow.telemetry.metric_file import map_name
from aquaflow.tracking.base import Base, prior_of

log = logging.getLogger(__name__)


def site_as_base(folder: Path) -> Base | None:
    """The merged site in ``folder``; None where it is no site. Behind ``aquaflow.bases``.

    The keyframes of a site are numbered as in its merge, and its components stand for sub-maps. A
    dive that is gone, or that changed since the merge, is left out.

    Raises:
        InputError: it was not merged, or nothing of it can be read.
    """
    if not is_site(folder):
        return None
    merged = merge_of(folder)
    dives = {dive.name: dive.folder(folder) for dive in read_site(folder)}
    files: dict[int, PlacesFile] = {}
    for number, (name, before) in enumerate(merged.fingerprints.items()):
        try:
            files[number] = _check_unchanged(dives.get(name, folder / name), before)
        except InputError as error:
            log.warning("%s is left out of %s: %s", name, folder, error)
    places, origins = _places(merged, files)
    if not places:
        raise InputError(
            f"no dive of {folder} is as it was merged; run `aquaflow site merge {folder}` again"
        )

    def keypoints(number: int) -> KeypointDepths:
        dive, keyframe = origins[number]
        return files[dive].keypoints(keyframe)

    names = list(merged.fingerprints)
    placed = {(each.dive, each.number): each.T_sm for each in merged.sub_maps}

    @cache
    def map_of(number: int) -> tuple[Path, Sim3] | None:
        name, sub_map = names[origins[number][0]], int(merged.keyframes[number]["sub_map"])
        dive, T_sm = dives.get(name, folder / name), placed.get((name, sub_map))
        path = dive / map_name(sub_map, Dive(dive).main)
        return (path, T_sm) if T_sm is not None and path.is_file() else None

    frames = {i: frame_of(stated, dives) for i, stated in enumerate(merged.components)}
    prior = next((p for p in map(prior_of, dives.values()) if p), "")
    return Base(folder, prior, tuple(places), keypoints, frames, map_of)


def _check_unchanged(dive: Path, before: str) -> PlacesFile:
    check_unchanged(dive, before)
    return Dive(dive).places


def _places(
    merged: MergedSite, files: dict[int, PlacesFile]
) -> tuple[list[KeyframePlace], dict[int, tuple[int, int]]]:
    """Keyframes in their component's world, and the dive and number of each there."""
    places, origins = [], {}
    for number, row in enumerate(merged.keyframes):
        dive, keyframe = int(row["dive"]), int(row["number"])
        known = files[dive].by_number.get(keyframe) if dive in files else None
        if known is not None:
            T_sc = Sim3(row["R"].copy(), row["t"].copy(), float(row["scale"]))
            component = int(row["component"])
            places.append(replace(known, number=number, sub_map=component, T_mc=T_sc))
            origins[number] = dive, keyframe
    return places, origins
