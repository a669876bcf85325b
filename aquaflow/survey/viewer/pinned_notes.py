"""Notes that a browser pins to a finished dive's map, kept in its ``notes.geojson``."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.survey.measure.notes import MOST_NOTES, Note, Shape, read_notes, write_notes
from aquaflow.survey.viewer.measuring import Asked, is_finite, vector
from aquaflow.survey.viewer.tools import NOTES
from aquaflow.telemetry.world_frame import WorldFrame

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
        notes = read_notes(self.dive, frame)
        left = [note for note in notes if note.key != given.get("key")]
        if len(left) == len(notes):
            raise InputError("there is no such note any more; reload the page")
        write_notes(self.dive, left, frame)
        return {}

    def _frame(self) -> WorldFrame:
        return Dive(self.dive).frame


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
