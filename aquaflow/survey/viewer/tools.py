"""What a browser may ask for by pointing at the map; all of it is checked, and answers in words."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.survey.measure.notes import MOST_NOTES, Note, Shape, read_notes, write_notes
from aquaflow.survey.measure.points import MOST_POINTS
from aquaflow.survey.measure.viewpoints import LONGEST as LONGEST_NAME
from aquaflow.survey.measure.viewpoints import (
    Viewpoint,
    read_viewpoints,
    write_viewpoints,
)
from aquaflow.survey.viewer.measuring import (
    Asked,
    LengthUnit,
    MeasuringScene,
    box_of,
    is_finite,
    measure,
    ray_of,
    vector,
)
from aquaflow.survey.viewer.picking import pick
from aquaflow.survey.viewer.section import section
from aquaflow.survey.viewer.splats import ViewerSplats
from aquaflow.survey.viewer.viewer_content import ViewerContent
from aquaflow.telemetry.world_frame import WorldFrame

NOTES, SCALE, LEVEL = ("notes/list", "notes/add", "notes/remove"), "scale", "level"
VIEWPOINTS = ("viewpoints/list", "viewpoints/add", "viewpoints/remove")
"""Names of the tools that a finished dive has besides."""
BUSY_S = 20.0
"""A browser waits so long for the one before it; then it is told so."""


@dataclass
class Tools:
    """Answers browsers, one at a time; ``others`` are a dive's own tools by name."""

    frame: LengthUnit = field(default_factory=lambda: LengthUnit.of(WorldFrame.unknown()))
    others: dict[str, Callable[[Asked], Asked]] = field(default_factory=dict)
    exhibit: ViewerContent | None = None
    _turn: threading.Lock = field(default_factory=threading.Lock)

    def can(self) -> tuple[str, ...]:
        """Which buttons the page has besides those that measure."""
        there = set(self.others)
        found = {"note": set(NOTES) <= there, "view": set(VIEWPOINTS) <= there}
        found |= {name: name in self.others for name in (SCALE, LEVEL)}
        return tuple(name for name, there in found.items() if there)

    def ask(self, name: str, given: Asked) -> Asked:
        """What the tool of that name says.

        Raises:
            InputError: there is no such tool, or it cannot do that, in a sentence for the browser.
        """
        tool = {"pick": self._pick, "measure": self._measure, **self.others}.get(name)
        if tool is None:
            raise InputError("this dive has no such tool; reload the page")
        if not self._turn.acquire(timeout=BUSY_S):
            raise InputError("the viewer is busy with other requests; try again")
        try:
            return tool(given)
        finally:
            self._turn.release()

    def _pick(self, given: Asked) -> Asked:
        found = pick(self._shown(given), *ray_of(given))
        return {"place": found.place.tolist(), "range": found.range, "sigma": found.sigma}

    def _measure(self, given: Asked) -> Asked:
        asked = given.get("points")
        if not isinstance(asked, list) or not 0 < len(asked) <= MOST_POINTS:
            raise InputError(f"a measurement needs 1 to {MOST_POINTS} points; mark them again")
        if not all(isinstance(each, dict) for each in asked):
            raise InputError("a point to measure is none; mark it again")
        shown, exhibit = self._shown(given), self.exhibit
        assert exhibit is not None
        camera = exhibit.camera
        width = 1.0 if camera is None else camera.camera.width / camera.camera.fx
        cameras = exhibit.path[:, :3].astype(np.float64)
        scene = MeasuringScene(shown, cameras, width, np.array(exhibit.up), self.frame)
        if given.get("what") == "section":
            return section(asked, given.get("thickness"), scene)
        return measure(str(given.get("what")), asked, scene)

    def _shown(self, given: Asked) -> ViewerSplats:
        """The Gaussians that a browser shows, by what it says of them: with ``all`` what floats
        too, of those in its ``box``."""
        shown = None if self.exhibit is None else self.exhibit.map
        if shown is None:
            raise InputError("there is no map yet to point at; wait for it")
        splats = shown.splats()
        if not given.get("all"):
            splats = splats.among(slice(splats.floaters, None))
        low, high = box_of(given.get("box"))
        within = (splats.centres >= low) & (splats.centres <= high)
        inside = np.asarray(within.all(axis=1), bool)
        return splats if inside.all() else splats.among(inside)


# --------------------------------------------------------------------------------------------------
# Notes that a browser pins to a finished dive's map, kept in its ``notes.geojson``.

LONGEST = 1000
"""Characters of a note's text."""
MOST_QUANTITIES = 8
"""Measured at one note."""
MOST_PLACES = 1000
"""Of one note."""


@dataclass(frozen=True)
class PinnedNotes:
    """The notes of the dive in a folder; one request at a time."""

    dive: Path

    def tools(self) -> dict[str, Callable[[Asked], Asked]]:
        """What answers, by name."""
        return dict(zip(NOTES, (self.all, self.add, self.remove), strict=True))

    def all(self, _: Asked) -> Asked:
        """All of them."""
        return {"notes": [_note_in_words(note) for note in read_notes(self.dive, self._frame())]}

    def add(self, given: Asked) -> Asked:
        """One more: ``text``, ``shape`` and ``places`` of the map, and what was ``measured`` there.

        Raises:
            InputError: it is no note, or the file cannot be read or written.
        """
        text, shape, places = given.get("text"), given.get("shape"), given.get("places")
        if not isinstance(text, str) or not text.strip() or len(text) > LONGEST:
            raise InputError(f"a note has 1 to {LONGEST} characters; write some")
        shapes: dict[Any, Shape] = {each: each for each in get_args(Shape)}
        if not isinstance(shape, str) or shape not in shapes:
            raise InputError("a note is a point, a line or an area; mark it again")
        if not isinstance(places, list) or not 0 < len(places) <= MOST_PLACES:
            raise InputError(f"a note has 1 to {MOST_PLACES} places; mark it again")
        at = np.array([vector(place, "a place of the note") for place in places])
        frame = self._frame()
        notes = read_notes(self.dive, frame)
        if len(notes) >= MOST_NOTES:
            raise InputError(f"a dive holds {MOST_NOTES} notes at most; remove some")
        known = {"measured": checked} if (checked := _measure(given.get("measured"))) else {}
        note = Note(secrets.token_hex(6), text.strip(), shapes[shape], at, known)
        write_notes(self.dive, [*notes, note], frame)
        return {"key": note.key}

    def remove(self, given: Asked) -> Asked:
        """The note with ``key``.

        Raises:
            InputError: there is none, or the file cannot be read or written.
        """
        frame = self._frame()
        left = _without(read_notes(self.dive, frame), given.get("key"), "note")
        write_notes(self.dive, left, frame)
        return {}

    def _frame(self) -> WorldFrame:
        return Dive(self.dive).frame


Kept = TypeVar("Kept", Note, Viewpoint)


def _without(kept: Sequence[Kept], key: Any, name: str) -> list[Kept]:
    """All but the one with ``key``; raises InputError where there is none."""
    left = [each for each in kept if each.key != key]
    if len(left) == len(kept):
        raise InputError(f"there is no such {name} any more; reload the page")
    return left


def _measure(given: Any) -> dict[str, Any]:
    """Quantities by name, as :func:`aquaflow.survey.viewer.measuring.measure` says them."""
    found: dict[str, Any] = {}
    for name, quantity in given.items() if isinstance(given, dict) else ():
        if not isinstance(quantity, dict) or len(found) >= MOST_QUANTITIES:
            raise InputError("what was measured is no quantity; measure it again")
        numbers = {key: quantity.get(key) for key in ("value", "sigma", "low_95", "high_95")}
        if not all(value is None or is_finite(value) for value in numbers.values()):
            raise InputError("a measured number is not finite; measure it again")
        found[str(name)[:40]] = numbers | {"unit": str(quantity.get("unit", ""))[:40]}
    return found


def _note_in_words(note: Note) -> Asked:
    return {
        "key": note.key, "text": note.text, "shape": note.shape, "places": note.places.tolist(),
    }  # fmt: skip


# --------------------------------------------------------------------------------------------------
# Views that a browser keeps with a finished dive, in its ``viewpoints.json``.


@dataclass(frozen=True)
class SavedViewpoints:
    """The saved views of the dive in a folder; one request at a time."""

    dive: Path

    def tools(self) -> dict[str, Callable[[Asked], Asked]]:
        """What answers, by name."""
        return dict(zip(VIEWPOINTS, (self.all, self.add, self.remove), strict=True))

    def all(self, _: Asked) -> Asked:
        """All of them, each with what an address says of it."""
        found = read_viewpoints(self.dive, self._frame())
        return {
            "viewpoints": [{"key": v.key, "name": v.name, "link": v.link} for v in found],
        }

    def add(self, given: Asked) -> Asked:
        """One more: its ``name``, and the ``link`` that an address has after its ``#``.

        Raises:
            InputError: it is no view, or the file cannot be read or written.
        """
        name, link = given.get("name"), given.get("link")
        if not isinstance(name, str) or not name.strip() or len(name) > LONGEST_NAME:
            raise InputError(f"a view's name has 1 to {LONGEST_NAME} characters; write some")
        if not isinstance(link, str):
            raise InputError("the view to keep is none; move it")
        frame = self._frame()
        before = read_viewpoints(self.dive, frame)
        added = Viewpoint.of_link(secrets.token_hex(6), name, link)
        write_viewpoints(self.dive, [*before, added], frame)
        return {"key": added.key}

    def remove(self, given: Asked) -> Asked:
        """The view with ``key``.

        Raises:
            InputError: there is none, or the file cannot be read or written.
        """
        frame = self._frame()
        left = _without(read_viewpoints(self.dive, frame), given.get("key"), "view")
        write_viewpoints(self.dive, left, frame)
        return {}

    def _frame(self) -> WorldFrame:
        return Dive(self.dive).frame
