"""A finished dive in the viewer: ``aquaflow view DIVE``."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeAlias

from aquaflow.base.errors import DamagedError, InputError, printable, reason_of
from aquaflow.base.storage.dive_status import refuse_missing, unfinished_reason
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.dive import CAMERA, FRAMES, TRAJECTORY, Dive
from aquaflow.geometry.camera import CameraModel
from aquaflow.survey.measure.points import MOST_POINTS
from aquaflow.survey.measure.shapes import LEAST_CORNERS
from aquaflow.survey.viewer.dive_map import DiveMap, read_map
from aquaflow.survey.viewer.dive_path import DivePath, read_path
from aquaflow.survey.viewer.levels import Palette
from aquaflow.survey.viewer.measuring import Asked, LengthUnit, vector
from aquaflow.survey.viewer.packing import PackedFile, key_of, read_packed, write_packed
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.survey.viewer.seen_water import SeenWater, water_of
from aquaflow.survey.viewer.splats import ViewerSplats
from aquaflow.survey.viewer.tools import LEVEL, SCALE, PinnedNotes, SavedViewpoints, Tools
from aquaflow.telemetry.world_frame import WorldFrame

log = logging.getLogger(__name__)

WHOLE = ("map.ply", TRAJECTORY, CAMERA, FRAMES)
"""Files without which a folder is no finished dive."""


@dataclass(frozen=True)
class FinishedDive:
    """What the viewer shows of a dive folder."""

    folder: Path
    ply: Path
    """Of the Gaussians that are shown: without the water where it is known."""
    map: Callable[[], DiveMap]
    """Reads the Gaussians when it is first called."""
    packed: PackedFile | None
    """Of an earlier look: then a browser needs no :attr:`map` to see them."""
    key: dict[str, Any]
    """Of a packed map of this dive as it is now."""
    water: SeenWater | None
    path: DivePath
    camera: CameraModel
    frame: WorldFrame

    @property
    def splats(self) -> ViewerSplats:
        """The Gaussians that are shown."""
        return self.map().splats

    @property
    def palettes(self) -> dict[str, Palette]:
        """Palettes of the splats' levels."""
        return self.map().palettes if self.packed is None else self.packed.palettes

    @property
    def summary(self) -> str:
        """Paragraphs for the panel."""
        if self.packed is None:
            count, total = self.map().at_once, self.map().total
        else:
            count, total = self.packed.at_once, self.packed.total
        of_all = f"{len(self.path.poses)} poses, {count} of {total} Gaussians"
        said = f"{printable(self.folder.name)}: {of_all}\n\n{frame_in_words(self.frame)}"
        return "\n\n".join(filter(None, (said, note_unfinished(self.folder))))


def frame_in_words(frame: WorldFrame) -> str:
    """Unit and axes."""
    unit = "Lengths are map units"
    if frame.metric:
        unit = f"Lengths are metres, \u00b1 {100.0 * frame.scale_sigma:.2g} %"
    return f"{unit}; {frame.axes}"


def finished_dive(dive: Dive, budget: int) -> FinishedDive:
    """What the viewer shows of ``dive``; its Gaussians are read when they are asked for.

    Raises:
        InputError: it is not finished.
    """
    refuse_missing(dive.path)
    said = unfinished_reason(dive.path)
    for name in WHOLE:
        if not dive.has(name):
            raise InputError(said or f"{dive} holds no finished dive: {name} is missing")
    path, frame, camera, folder = read_path(dive), dive.frame, dive.camera, dive.path
    water, ply = _water(dive), dive.file("map_clear.ply")
    if water is None or not ply.is_file():  # colours with the water in them are all there is
        water, ply = None, dive.file("map.ply")
    key = key_of(folder, budget)
    return FinishedDive(
        folder, ply, cache(partial(read_map, dive, ply, path.poses, frame, budget)),
        read_packed(folder, key), key, water, path, camera, frame,
    )  # fmt: skip


def note_unfinished(folder: Path) -> str:
    """What the viewer says of a dive that is shown as far as it came; empty of a finished one."""
    said = unfinished_reason(folder)
    return "" if said is None else f"What is shown may be of several moments: {said}"


def show_dive(dive: FinishedDive, config: ViewerConfig, tools: Tools | None = None) -> ViewerPage:
    """The viewer's page of ``dive``."""
    page = ViewerPage(config, f"{dive.folder.resolve().name}: AquaFlow", tools=tools)
    fill(page, dive)
    page.finish()  # who asked in the meantime, as the page of a preview does, asks again
    return page


def show_folder(folder: Path, config: ViewerConfig) -> ViewerPage:
    """The viewer's page of the finished dive in ``folder``, without tools; behind
    ``aquaflow.views``.

    Raises:
        InputError: there is no finished dive, or the address is taken.
        ConfigError: the token will not do.
    """
    return show_dive(finished_dive(Dive(folder), config.splats), config)


def fill(page: ViewerPage, dive: FinishedDive) -> None:
    """Show ``dive`` on ``page``, in place of what was there."""
    page.set_frame(LengthUnit.of(dive.frame), dive.frame.north)
    page.show_health(dive.summary)
    if dive.packed is not None:
        page.show_packed(dive.packed, lambda: dive.splats, dive.water, dive.palettes)
    else:
        page.show_packed(dive.map().packed, lambda: dive.splats, dive.water, dive.palettes)
    path = dive.path.thin()
    page.show_path(path.rows, path.moments, path.began)
    page.show_pictures(path.pictures)
    if path.poses:
        page.show_camera(path.poses[0], dive.camera, None)


def open_dive(
    folder: Path,
    config: ViewerConfig,
    mark: Mark | None = None,
    white_balance: str | None = None,
    turn: Turn | None = None,
) -> ViewerPage:
    """The page of the finished dive in ``folder``, with its notes and saved views, its scale
    bar (by ``mark``) and, where telemetry has not measured gravity, what turns it level (by
    ``turn``); in another ``white_balance`` than its own, where one is given.

    Raises:
        InputError: there is no finished dive, the address is taken, or the dive cannot be shown in
            that white balance.
        ConfigError: the token will not do.
    """
    tools = Tools(others=PinnedNotes(folder).tools() | SavedViewpoints(folder).tools())
    page: list[ViewerPage] = []

    def read() -> FinishedDive:
        dive = Dive(folder)
        if white_balance is not None:
            from aquaflow.dive.white_balance import show_in  # loads torch

            show_in(dive, white_balance)
        return finished_dive(dive, config.splats)

    def scale(given: Asked) -> Asked:
        said = mark_coverage(given, mark) if mark is not None else {}
        if said.get("rescaled"):
            fill(page[0], read())
        return said

    def level(given: Asked) -> Asked:
        assert turn is not None
        words = turn(level_places(given))
        fill(page[0], read())
        return {"words": words}

    if mark is not None:
        tools.others[SCALE] = scale
    dive = read()
    if turn is not None and not dive.frame.gravity_measured:
        tools.others[LEVEL] = level
    page.append(show_dive(dive, config, tools))
    prepare(folder, dive.key, dive.packed, dive.map, page[0])
    return page[0]


def prepare(
    folder: Path,
    key: dict[str, Any],
    packed: PackedFile | None,
    whole: Callable[[], DiveMap],
    page: ViewerPage,
) -> threading.Thread:
    """Behind the page: the Gaussians are read, for who points at them, or their packing is kept
    in ``folder``. ``packed``: of an earlier look, if the page shows that."""

    def work() -> None:
        try:
            shown = page.packed
            if packed is not None:
                whole()
            elif shown is not None:
                write_packed(folder, key, shown, whole().palettes, whole().total)
        except InputError as error:  # who points is told so
            log.warning("%s", error)

    thread = threading.Thread(target=work, name="viewer's map", daemon=True)
    thread.start()
    return thread


def _water(dive: Dive) -> SeenWater | None:
    """None for a dive without water, and for a file that does not say it."""
    try:
        water = water_of(dive.medium_facts)
        if water is None or dive.white_balance is None:
            return water
        return in_chosen_white(dive, water)
    except (InputError, ValueError, AttributeError, DamagedError) as error:
        log.warning("the viewer shows no water: %s: %s", dive, reason_of(error))
        return None


def in_chosen_white(dive: Dive, water: SeenWater) -> SeenWater:
    """The water, with the white balance and tone that were chosen for the dive's map since.

    Raises:
        InputError: its map is missing or damaged.
    """
    from aquaflow.mapping.appearance import shown_tone  # loads torch

    mapper = dive.map()
    tone, balance = shown_tone(mapper), mapper.scene.balance
    assert balance is not None
    red, green, blue = (
        tone.exposure * now / before for now, before in zip(balance.white, water.gain, strict=True)
    )
    return replace(water, white=(red, green, blue), shown_compression=tone.compression)


# --------------------------------------------------------------------------------------------------
# The scale bar: two points of the map and the true length between them. Points on a level plane.

Place: TypeAlias = tuple[float, float, float]
Mark: TypeAlias = Callable[[tuple[Place, Place], float, float], tuple[str, bool]]
"""Keeps a length between two points of the map: metres and 1 sigma of them. Returns sentences about
it, and whether the dive's files were rescaled."""


def mark_coverage(given: Asked, mark: Mark) -> Asked:
    """What a browser is told of the scale bar that it asked for.

    Raises:
        InputError: it is none, or a file of the dive cannot be read or written.
    """
    places = given.get("places")
    if not isinstance(places, list) or len(places) != 2:
        raise InputError("a scale bar has two ends; mark both")
    a, b = (vector(place, "an end of the scale bar") for place in places)
    length, sigma = (_metres(given.get(name), name) for name in ("length_m", "sigma_m"))
    words, rescaled = mark(((a[0], a[1], a[2]), (b[0], b[1], b[2])), length, sigma)
    return {"words": words, "rescaled": rescaled}


Turn: TypeAlias = Callable[[list[Place]], str]
"""Turns the dive's files level by points of its map; returns sentences about it."""


def level_places(given: Asked) -> list[Place]:
    """The points of something level that a browser marked.

    Raises:
        InputError: they are none, too few or too many.
    """
    places = given.get("places")
    if not isinstance(places, list) or not LEAST_CORNERS <= len(places) <= MOST_POINTS:
        raise InputError(f"a plane has {LEAST_CORNERS} to {MOST_POINTS} points; mark them again")
    found = [vector(place, "a point of the plane") for place in places]
    return [(float(x), float(y), float(z)) for x, y, z in found]


def _metres(given: Any, name: str) -> float:
    if not isinstance(given, (int, float)) or not 0.0 < given < math.inf:
        what = "length" if name == "length_m" else "1 sigma"
        raise InputError(f"the {what} of the scale bar must be a positive number of metres")
    return float(given)
