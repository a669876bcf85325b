"""A merged site in the viewer, ``aquaflow view SITE``: maps, paths and pictures of its dives."""

from __future__ import annotations

import logging
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError, printable
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import PlyGaussians, read_ply
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.site.site_map_file import join, read_site_map
from aquaflow.survey.viewer.dive_map import CLASSES, COVERAGE, DiveMap, coverage_of_dive
from aquaflow.survey.viewer.dive_path import LONGEST_PATH
from aquaflow.survey.viewer.finished import frame_in_words, prepare
from aquaflow.survey.viewer.floaters import find_floaters
from aquaflow.survey.viewer.levels import RANGE, RGB, Palette, range_level
from aquaflow.survey.viewer.measuring import LengthUnit
from aquaflow.survey.viewer.moments import HEADING, PICTURE
from aquaflow.survey.viewer.packing import read_packed
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.survey.viewer.site_dives import PlacedDive, ShownSite, read_shown
from aquaflow.survey.viewer.splats import Levels, splats
from aquaflow.survey.viewer.viewer_content import PathPart

log = logging.getLogger(__name__)

DIVE = "dive"
"""Name of the level that says whose a Gaussian is."""
DIVE_COLOURS: tuple[RGB, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
)
"""Those of Okabe and Ito (2008), told apart without red and green; more dives share them."""
MOST_NAMED = 255
"""Dives that have a number of their own in that level."""


def open_site(site: Path, config: ViewerConfig, component: int | None = None) -> ViewerPage:
    """The page of the merged site in ``site``; ``component``: by default its largest.

    Raises:
        InputError: there is nothing to show, or the address is taken.
        ConfigError: the token will not do.
    """
    shown = read_shown(site, component, config.splats)
    key = _key(shown)
    packed = read_packed(site, key)
    whole = cache(partial(map_of_site, shown, config.splats))
    page = ViewerPage(config, f"{site.resolve().name}: AquaFlow")
    frame = shown.frame
    page.set_frame(LengthUnit.of(frame), frame.north)
    if packed is not None:
        page.show_packed(packed, lambda: whole().splats, None, packed.palettes)
        count, total = packed.count, packed.total
    else:
        page.show_splats(whole().splats, None, whole().palettes)
        count, total = len(whole().splats), whole().total
    page.show_health(_in_words(shown, count, total))
    _show_paths(page, shown)
    page.finish()
    prepare(site, key, packed, whole, page)
    return page


def map_of_site(shown: ShownSite, budget: int) -> DiveMap:
    """The Gaussians of all dives in the site's world, at most ``budget``, those that cover most.

    Raises:
        InputError: a map cannot be read.
    """
    numbers: list[Levels] = []
    classes: list[Levels | None] = []
    maps = _one_map(shown) or [_own_map(placed) for placed in shown.dives]
    for number, (placed, own) in enumerate(zip(shown.dives, maps, strict=True)):
        in_n = placed.T_sn.inverse().apply(np.asarray(own.means, np.float64))
        classes.append(coverage_of_dive(Dive(placed.dive.folder), in_n, placed.dive.frame))
        numbers.append(np.full(len(own.means), min(number, MOST_NAMED), np.uint8))
    names = tuple(placed.name for placed in shown.dives)[: MOST_NAMED + 1]
    stops = tuple(DIVE_COLOURS[i % len(DIVE_COLOURS)] for i in range(len(names)))
    levels: dict[str, Levels] = {DIVE: np.concatenate(numbers)}
    palettes = {DIVE: Palette("by dive", stops, names)}
    covered = [each for each in classes if each is not None]
    if len(covered) == len(maps):
        levels[COVERAGE], palettes[COVERAGE] = np.concatenate(covered), CLASSES
    all_of = join(maps)
    cameras = np.concatenate([placed.path.places for placed in shown.dives])
    if len(cameras) and len(all_of.means):
        levels[RANGE], palettes[RANGE] = range_level(all_of.means, cameras, shown.frame.unit)
    floaters = np.concatenate([
        find_floaters(own, placed.path.poses, placed.dive.camera)
        for placed, own in zip(shown.dives, maps, strict=True)
    ])  # fmt: skip
    found = splats(
        all_of.means, all_of.wxyz, all_of.scales, all_of.opacities, all_of.colours, budget, levels,
        floaters,
    )  # fmt: skip
    return DiveMap(lambda: found, palettes, len(all_of.means))


def _own_map(placed: PlacedDive) -> PlyGaussians:
    return read_ply(placed.dive.ply).transform(placed.T_sn)


def _one_map(shown: ShownSite) -> list[PlyGaussians] | None:
    """What the site's one map has of each dive that is shown, where there is one of these."""
    if shown.one_map is None:
        return None
    try:
        parts = read_site_map(shown.folder, shown.component, shown.one_map)
    except InputError as error:
        log.warning("the dives' own maps are shown: %s", error)
        return None
    return [parts[placed.name] for placed in shown.dives]


def _show_paths(page: ViewerPage, shown: ShownSite) -> None:
    """One after the other; a picture's number is its frame's, after those of the dives before."""
    rows, moments, parts = [], [], []
    pictures: dict[int, Path] = {}
    first = before = 0
    for placed in shown.dives:
        path = placed.path.thin(max(1, LONGEST_PATH // len(shown.dives)))
        own = path.moments.copy()
        own[:, PICTURE] += before
        if not _same_north(placed, shown):
            own[:, HEADING] = np.nan
        pictures |= {before + index: file for index, file in path.pictures.items()}
        parts.append(PathPart(placed.name, first, path.began, placed.dive.camera))
        rows.append(path.rows)
        moments.append(own)
        first += len(path.poses)
        before += max(path.pictures, default=-1) + 1
    page.show_path(np.concatenate(rows), np.concatenate(moments), parts=parts)
    page.show_pictures(pictures)
    start = next((T for placed in shown.dives for T in placed.path.poses), Sim3.identity())
    page.show_camera(start, shown.dives[0].dive.camera, None)


def _same_north(placed: PlacedDive, shown: ShownSite) -> bool:
    """Headings of a dive are counted from what those of the site are."""
    north = shown.frame.north
    return placed.dive.frame.north == north and north.endswith("north")


def _key(shown: ShownSite) -> dict[str, Any]:
    """By what a packed map is known to be of these dives, where they are now."""
    dives = [[placed.name, placed.dive.key, placed.T_sn.matrix.tolist()] for placed in shown.dives]
    one_map = None if shown.one_map is None else [part.gaussians for part in shown.one_map]
    return {"component": shown.component, "dives": dives, "one_map": one_map}


def _in_words(shown: ShownSite, count: int, total: int) -> str:
    poses = sum(len(placed.path.poses) for placed in shown.dives)
    dives = len(shown.dives)
    words = [
        f"{printable(shown.folder.name)}: {dives} {'dive' if dives == 1 else 'dives'}, "
        f"{poses} poses, {count} of {total} Gaussians"
        + ("" if shown.one_map is None else " of the one map of all of them"),
        frame_in_words(shown.frame),
    ]
    if shown.components > 1:
        words.append(
            f"Component {shown.component} of 0 to {shown.components - 1}; the others never met it"
        )
    words += [f"{name} is not shown: {reason}" for name, reason in shown.left_out.items()]
    return "\n\n".join(words)
