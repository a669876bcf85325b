"""Notes pinned to the map: ``notes.geojson`` in the dive folder, docs/formats.md#notes.

A GeoJSON FeatureCollection (RFC 7946). Where the dive is placed on the earth, geometries are
longitude, latitude (degrees, WGS 84) and height above the ellipsoid (m; the water surface is taken
to lie on it). Elsewhere a feature has no geometry, which the RFC calls unlocated, and the member
``local`` holds one of the same form in n and the dive's unit: read as degrees, metres would be
somewhere else on the earth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, reason_of, reason_or_key
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import write_json
from aquaflow.geometry.earth import from_geodetic, geodetic
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]
Shape = Literal["Point", "LineString", "Polygon"]

NAME = "notes.geojson"
FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""
LEAST = {"Point": 1, "LineString": 2, "Polygon": 3}
"""Places of each shape; a polygon's first one is not repeated here, but in the file."""
MOST_NOTES, MOST_BYTES = 10_000, 1 << 26
"""In one file; more is no dive's, and takes a browser's memory."""


@dataclass(frozen=True)
class Note:
    """A text, and where in the map it belongs."""

    key: str
    """Unlike that of every other note of the dive."""
    text: str
    shape: Shape
    places: Array
    """[N, 3] in n of the largest sub-map, in the dive's unit."""
    properties: dict[str, Any] = field(default_factory=dict)
    """What else goes into the file, such as a measured length; JSON values alone."""

    def to_json(self) -> dict[str, Any]:
        """The note for machines: places [N, 3] in n and the dive's unit."""
        return {
            "key": self.key, "text": self.text, "shape": self.shape,
            "places": np.asarray(self.places).tolist(), "properties": self.properties,
        }  # fmt: skip


def write_notes(dive: Path, notes: Sequence[Note], frame: WorldFrame) -> None:
    """Write all notes of a dive, whose largest sub-map lies in ``frame``; replaces the file.

    Raises:
        InputError: a note is none, two have the same key, or the file cannot be written.
    """
    for note in notes:
        if problem := _problem(note):
            raise InputError(f"the note {note.key!r} {problem}")
    if len({note.key for note in notes}) < len(notes):
        raise InputError("two notes of the dive have the same key; give each its own")
    if len(notes) > MOST_NOTES:
        raise InputError(f"a dive holds {MOST_NOTES} notes at most; remove some")
    located = frame.georeferenced
    about = {
        "format": FORMAT,
        "unit": frame.unit,
        "located": located,
        "local_axes": frame.axes,
    }
    features = [_to_feature(note, frame) for note in notes]
    data = {"type": "FeatureCollection", "aquaflow": about, "features": features}
    write_json(dive / NAME, data)


def read_notes(dive: Path, frame: WorldFrame) -> list[Note]:
    """The notes of a dive, whose largest sub-map lies in ``frame``; none without such a file.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    path = dive / NAME
    try:
        data = read_regular_json(path, most_bytes=MOST_BYTES)
        features = data["features"]
        if not isinstance(features, list) or len(features) > MOST_NOTES:
            raise DamagedError(f"its features are no list of at most {MOST_NOTES}")
        unit = data.get("aquaflow", {}).get("unit", frame.unit)
        return [
            _to_note(feature, number, frame, unit) for number, feature in enumerate(features, 1)
        ]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        what = reason_or_key(error)
        raise InputError(f"{path} does not hold notes ({what}); correct or remove it") from error


def new_note(
    notes: Sequence[Note],
    text: str,
    shape: Shape,
    places: Array,  # [N, 3] in n
    properties: dict[str, Any],
) -> Note:
    """A note beside ``notes``, with the least number as its key that none of them has."""
    keys = {note.key for note in notes}
    number = 1
    while str(number) in keys:
        number += 1
    return Note(str(number), text, shape, places, properties)


def without(notes: Sequence[Note], keys: Sequence[str]) -> list[Note]:
    """The notes that have none of the ``keys``.

    Raises:
        InputError: no note has one of the keys; then none is removed.
    """
    known = {note.key for note in notes}
    missing = [key for key in keys if key not in known]
    if missing:
        raise InputError(f"the dive has no note {missing[0]!r}; --notes lists their keys")
    return [note for note in notes if note.key not in keys]


def list_notes(notes: Sequence[Note]) -> list[str]:
    """A line for each: its key, what it marks, and its text."""
    width = max((len(note.key) for note in notes), default=0)
    words = {"Point": "point", "LineString": "line", "Polygon": "area"}
    return [f"{note.key:<{width}}  {words[note.shape]:<5}  {note.text}" for note in notes]


def moved_notes(notes: Sequence[Note], change: Sim3) -> list[Note]:
    """Notes of a dive whose n was brought to another by ``change``, as by ``aquaflow measure
    scale``."""
    return [replace(note, places=change.apply(note.places)) for note in notes]


def _problem(note: Note) -> str | None:
    """What makes it no note, as the end of a sentence."""
    least = LEAST.get(note.shape)
    if least is None:
        return f"is no {', '.join(LEAST)} but {note.shape!r}"
    places = np.asarray(note.places)
    if places.ndim != 2 or places.shape[1] != 3 or not np.isfinite(places).all():
        return "has a place that is not three finite numbers"
    if len(places) < least or (note.shape == "Point" and len(places) != 1):
        return f"has {len(places)} places, which make no {note.shape}"
    return None


def _to_feature(note: Note, frame: WorldFrame) -> dict[str, Any]:
    properties = note.properties | {"text": note.text}
    feature: dict[str, Any] = {"type": "Feature", "id": note.key}
    origin = frame.origin
    if frame.georeferenced and origin is not None:
        places = geodetic(note.places, (origin.latitude_deg, origin.longitude_deg))
        # Seen from above, a ring runs against the clock (RFC 7946, 3.1.6).
        return feature | {"geometry": _geometry(note, places), "properties": properties}
    local = _geometry(note, note.places)
    return feature | {"geometry": None, "local": local, "properties": properties}


def _geometry(
    note: Note,
    places: Array,  # [N, 3]
) -> dict[str, Any]:
    coordinates: list[Any] = places.tolist()
    if note.shape == "Point":
        return {"type": note.shape, "coordinates": coordinates[0]}
    if note.shape == "LineString":
        return {"type": note.shape, "coordinates": coordinates}
    x, y = places[:, 0], places[:, 1]
    if float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) < 0.0:
        coordinates = [coordinates[0], *coordinates[:0:-1]]
    return {"type": note.shape, "coordinates": [[*coordinates, coordinates[0]]]}


def _to_note(feature: dict[str, Any], number: int, frame: WorldFrame, unit: str) -> Note:
    """Raises ValueError, KeyError or TypeError for what is none."""
    origin = frame.origin
    located = feature.get("geometry") is not None
    if located and (origin is None or not frame.georeferenced):
        raise DamagedError(f"feature {number} lies on the earth, and the dive does not")
    if not located and unit != frame.unit:
        raise DamagedError(f"feature {number} is in {unit}, and the dive in {frame.unit}")
    geometry = feature["geometry" if located else "local"]
    shape = geometry["type"]
    if shape not in get_args(Shape):
        raise DamagedError(f"feature {number} is no {', '.join(LEAST)}")
    places = _places(geometry["coordinates"], shape, number)
    if located and origin is not None:
        place = (origin.latitude_deg, origin.longitude_deg)
        places = from_geodetic(places[:, 1], places[:, 0], places[:, 2], place)
    properties = dict(feature.get("properties") or {})
    text = str(properties.pop("text", ""))
    note = Note(str(feature.get("id", number)), text, shape, places, properties)
    if problem := _problem(note):
        raise DamagedError(f"feature {number} {problem}")
    return note


def _places(coordinates: Any, shape: str, number: int) -> Array:
    """[N, 3]; a ring without the repetition of its first place."""
    if shape == "Point":
        coordinates = [coordinates]
    elif shape == "Polygon":
        if len(coordinates) != 1:
            raise DamagedError(f"feature {number} has holes, which AquaFlow's notes have not")
        coordinates = coordinates[0]
        if len(coordinates) > 1 and coordinates[0] == coordinates[-1]:
            coordinates = coordinates[:-1]
    places = np.asarray(coordinates, np.float64)
    if places.ndim != 2 or places.shape[1] != 3:
        raise DamagedError(
            f"feature {number} has a place without height; give each three coordinates"
        )
    return places
