"""Notes pinned to the map, as GeoJSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.geometry.earth import latitude_longitude
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.measure.notes import (
    MOST_NOTES,
    NAME,
    Note,
    moved_notes,
    read_notes,
    write_notes,
)
from aquaflow.telemetry.world_frame import WorldFrame
from tests.metric_scenes import TRONDHEIM, metric_frame

RING = np.array([[0.0, 0.0, 9.0], [4.0, 0.0, 9.5], [4.0, 3.0, 9.2]])
NOTES = [
    Note("a", "Acropora, <b>bleached</b>", "Point", np.array([[12.0, -7.5, 9.25]])),
    Note("b", "chain", "LineString", RING[:2], {"length_m": 4.03}),
    Note("c", "patch", "Polygon", RING),
    Note("d", "the other way round", "Polygon", RING[::-1]),
]
LOCAL = {"origin": None, "north": "initial heading"}


def features(folder: Path) -> list[dict[str, Any]]:
    return list(json.loads((folder / NAME).read_text())["features"])


def spoil(folder: Path, change: dict[str, Any]) -> None:
    """Write one note, and change its feature."""
    write_notes(folder, NOTES[:1], metric_frame())
    data = json.loads((folder / NAME).read_text())
    data["features"][0] |= change
    (folder / NAME).write_text(json.dumps(data))


@pytest.mark.parametrize(
    "frame", [metric_frame(), metric_frame(**LOCAL), WorldFrame.unknown()],
    ids=["on the earth", "local", "map units"],
)  # fmt: skip
def test_notes_are_read_back_as_they_were_written(frame: WorldFrame, tmp_path: Path) -> None:
    assert read_notes(tmp_path, frame) == []
    write_notes(tmp_path, NOTES, frame)
    for read, note in zip(read_notes(tmp_path, frame), NOTES, strict=True):
        assert (read.key, read.text, read.shape) == (note.key, note.text, note.shape)
        assert read.properties == note.properties
        order = np.lexsort(read.places.T), np.lexsort(note.places.T)
        np.testing.assert_allclose(read.places[order[0]], note.places[order[1]], atol=1e-6)
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


def test_on_the_earth_geometries_are_those_of_the_rfc(tmp_path: Path) -> None:
    write_notes(tmp_path, NOTES, metric_frame())
    point, _, *rings = features(tmp_path)
    latitude, longitude = latitude_longitude(
        NOTES[0].places, (TRONDHEIM.latitude_deg, TRONDHEIM.longitude_deg)
    )
    assert point["geometry"]["coordinates"][:2] == [longitude[0], latitude[0]]
    assert point["geometry"]["coordinates"][2] == pytest.approx(-9.25, abs=1e-3)
    for ring in rings:
        [places] = ring["geometry"]["coordinates"]
        assert places[0] == places[-1]
        x, y = np.array(places)[:, :2].T - np.array(places)[0, :2, None]
        assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0.0  # against the clock


def test_elsewhere_features_are_unlocated_and_keep_local_places(tmp_path: Path) -> None:
    write_notes(tmp_path, NOTES, metric_frame(**LOCAL))
    for feature, note in zip(features(tmp_path), NOTES, strict=True):
        assert feature["geometry"] is None
        assert feature["local"]["type"] == note.shape
    assert features(tmp_path)[0]["local"]["coordinates"] == [12.0, -7.5, 9.25]


def test_notes_grow_with_a_dive_that_becomes_metric(tmp_path: Path) -> None:
    write_notes(tmp_path, NOTES, WorldFrame.unknown())
    metric = metric_frame(**LOCAL)
    with pytest.raises(InputError, match="is in map units, and the dive in m"):
        read_notes(tmp_path, metric)
    write_notes(
        tmp_path,
        moved_notes(read_notes(tmp_path, WorldFrame.unknown()), Sim3(np.eye(3), np.zeros(3), 2.5)),
        metric,
    )
    np.testing.assert_allclose(read_notes(tmp_path, metric)[0].places, [[30.0, -18.75, 23.125]])


@pytest.mark.parametrize(
    ("note", "sentence"),
    [
        (Note("a", "", "Circle", RING), "is no Point"),  # type: ignore[arg-type]
        (Note("a", "", "Polygon", RING[:2]), "make no Polygon"),
        (Note("a", "", "Point", RING), "make no Point"),
        (Note("a", "", "Point", np.array([[np.nan, 0.0, 0.0]])), "not three finite numbers"),
    ],
)
def test_what_is_no_note_is_not_written(note: Note, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=sentence):
        write_notes(tmp_path, [note], metric_frame())
    assert list(tmp_path.iterdir()) == []


def test_keys_are_single_and_notes_not_without_end(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="same key"):
        write_notes(tmp_path, [NOTES[0], NOTES[0]], metric_frame())
    many = [Note(str(n), "", "Point", np.zeros((1, 3))) for n in range(MOST_NOTES + 1)]
    with pytest.raises(InputError, match="at most"):
        write_notes(tmp_path, many, metric_frame())


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"geometry": None}, "'local' is missing"),
        ({"geometry": {"type": "Point", "coordinates": [10.0, 63.0]}}, "without height"),
        ({"geometry": {"type": "MultiPoint", "coordinates": []}}, "is no Point"),
        ({"geometry": {"type": "LineString", "coordinates": [[1.0, 2.0, 3.0]]}}, "1 places"),
        ({"geometry": {"type": "Polygon", "coordinates": [[], []]}}, "has holes"),
        ({"geometry": {"type": "Point", "coordinates": [1.0, 2.0, float("inf")]}}, "not three"),
        ({"geometry": 3}, "correct or remove"),
    ],
)
def test_a_file_that_holds_something_else_is_named(
    change: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    spoil(tmp_path, change)
    with pytest.raises(InputError, match=sentence):
        read_notes(tmp_path, metric_frame())


@pytest.mark.parametrize("text", ["", "[1]", '{"features": 3}', '{"features": [1]}'])
def test_a_damaged_file_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / NAME).write_text(text)
    with pytest.raises(InputError, match="does not hold notes"):
        read_notes(tmp_path, metric_frame())


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / NAME).mkdir()
    with pytest.raises(InputError, match="cannot read"):
        read_notes(tmp_path, metric_frame())


def test_notes_on_the_earth_do_not_fit_a_dive_that_is_not(tmp_path: Path) -> None:
    write_notes(tmp_path, NOTES, metric_frame())
    with pytest.raises(InputError, match="lies on the earth"):
        read_notes(tmp_path, metric_frame(**LOCAL))
