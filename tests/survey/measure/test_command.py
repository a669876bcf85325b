"""``aquaflow measure``: in a dive over known ground, and in one that was mapped."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import ArgumentError
from aquaflow.base.errors.crash_report import FAILED, MISUSED
from aquaflow.dive.placement import to_geodetic
from aquaflow.survey.measure.asked import GeodeticPoint, MapPoint, Pixel, parse_point
from aquaflow.survey.measure.notes import Note, read_notes, write_notes
from aquaflow.telemetry.metric_file import read_frame_of_map
from tests.command_line import Cli
from tests.metric_scenes import TRONDHEIM, metric_frame
from tests.survey.export.survey_scenes import DEPTH_M, height, surveyed, write_survey

CORNERS = np.array([[0.8, 0.8], [0.8, 2.8], [2.8, 2.8], [2.8, 0.8]])
"""North and east."""


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_survey(tmp_path_factory.mktemp("measured") / "dive", surveyed())


def ground_n(
    north_east: np.ndarray,  # [N, 2] m
) -> np.ndarray:
    """[N, 3] points of the ground in n."""
    north, east = north_east.T
    return np.column_stack([north, east, DEPTH_M - height(north, east)])


def in_map(places: np.ndarray) -> list[str]:  # [N, 3]
    return [text for place in places for text in ("--point", "{:.6f},{:.6f},{:.6f}".format(*place))]


def on_earth(places: np.ndarray) -> list[str]:  # [N, 3]
    found = np.column_stack(to_geodetic(TRONDHEIM, places))
    return [text for place in found for text in ("--point", "{:.9f}N,{:.9f}E".format(*place))]


def asked(command: Cli, dive: Path, *arguments: object) -> dict[str, Any]:
    ran = command("measure", dive, *arguments, "--json")
    assert ran.code == 0, ran.err
    return dict(json.loads(ran.out))


@pytest.mark.parametrize("typed", [in_map, on_earth])
def test_two_points_are_a_distance(typed: Any, dive: Path, command: Cli) -> None:
    places = ground_n(CORNERS[:2])
    said = asked(command, dive, *typed(places))["measured"]["length"]
    true = np.linalg.norm(places[1] - places[0])
    assert said["value"] == pytest.approx(true, rel=0.01)
    assert said["low_95"] < true < said["high_95"]
    assert said["unit"] == "m"


def test_feet_are_printed_and_files_stay_in_metres(
    dive: Path, command: Cli, tmp_path: Path
) -> None:
    points, table = in_map(ground_n(CORNERS[:2])), tmp_path / "line.csv"
    said = asked(command, dive, *points, "--units", "feet")["measured"]["length"]
    assert said["unit"] == "m"
    ran = command("measure", dive, *points, "--units", "feet", "--csv", table)
    assert ran.code == 0, ran.err
    shown = re.search(r"length +([\d.]+) .* ft ", ran.out)
    assert shown is not None
    assert float(shown[1]) == pytest.approx(said["value"] / 0.3048, rel=0.01)
    assert ",m" in table.read_text()
    profile = command("measure", dive, *points, "--as", "profile", "--units", "feet").out
    assert re.search(r"heights from -3\d\.\d+ to -3\d\.\d+ ft", profile)


def test_a_pixel_is_where_its_ray_meets_the_map(dive: Path, command: Cli) -> None:
    """The cameras look straight down with north on top, 2 m above the ground."""
    said = asked(command, dive, "--point", "5:80,60", "--point", "10:80,60")
    below = ground_n(np.array([[1.4, 1.4], [2.2, 2.2]]))
    np.testing.assert_allclose(said["points"], below, atol=0.02)


def test_four_points_are_an_area_on_the_chart_and_on_the_ground(dive: Path, command: Cli) -> None:
    said = asked(command, dive, *in_map(ground_n(CORNERS)), "--cell", "0.1")["measured"]
    assert said["plan_area"]["low_95"] < 4.0 < said["plan_area"]["high_95"]
    assert said["plan_area"]["value"] == pytest.approx(4.0, rel=0.02)
    steps = np.linspace(0.8, 2.8, 1001)
    rise = np.gradient(height(*np.meshgrid(steps, steps)), steps[1] - steps[0])
    true = 4.0 * float(np.mean(np.sqrt(1.0 + rise[0] ** 2 + rise[1] ** 2)))
    assert said["surface_area"]["value"] == pytest.approx(true, rel=0.02)
    assert said["surface_area"]["low_95"] < true < said["surface_area"]["high_95"]


def test_a_profile_has_the_heights_of_the_ground(dive: Path, command: Cli, tmp_path: Path) -> None:
    ends, table = ground_n(CORNERS[:2]), tmp_path / "profile.csv"
    said = asked(command, dive, *on_earth(ends), "--as", "profile", "--csv", table, "--cell", 0.1)
    along, heights = (np.array(said["profile"][name]) for name in ("along", "height"))
    true = height(0.8 + 0.0 * along, 0.8 + along) - DEPTH_M
    np.testing.assert_allclose(heights, true, atol=0.02)
    assert said["measured"]["drop"]["value"] == pytest.approx(true[-1] - true[0], abs=0.02)
    rows = list(csv.DictReader(table.open()))
    assert [float(row["height_m"]) for row in rows] == pytest.approx(heights, abs=1e-4)


def test_a_measurement_is_pinned_to_the_map_with_its_text(dive: Path, command: Cli) -> None:
    places = ground_n(CORNERS[:2])
    for text in ("crack", "again"):
        assert command("measure", dive, *in_map(places), "--note", text).code == 0
    first, second = read_notes(dive, read_frame_of_map(dive / "map.aqf"))
    assert (first.text, second.text) == ("crack", "again")
    assert first.key != second.key
    np.testing.assert_allclose(first.places, places, atol=1e-3)
    assert first.properties["measured"]["length"]["unit"] == "m"


def test_a_mapped_dive_has_its_numbers_in_files_and_report(
    small_dive: Path, tmp_path: Path, command: Cli
) -> None:
    dive, table = Path(shutil.copytree(small_dive, tmp_path / "dive")), tmp_path / "numbers.csv"
    written = json.loads((dive / "reef_numbers.json").read_text())
    said = asked(command, dive, "--csv", table)
    assert "fewer than 30 cells" in said["missing"]["relief"]  # small pictures of little ground
    assert set(said["numbers"]) == set(written["numbers"]) >= {"path_length", "surveyed_area"}
    for name, number in said["numbers"].items():
        assert number["value"] == pytest.approx(written["numbers"][name]["value"], rel=0.01)
        assert number["low_95"] <= number["value"] <= number["high_95"]
    assert table.read_text().splitlines()[0] == "number,value,sigma,low_95,high_95,unit,meaning"
    assert (dive / "reef_numbers.csv").read_text().count("\n") == 1 + len(written["numbers"])
    assert "The ground in numbers" in (dive / "report.html").read_text()
    ran = command("measure", dive, "--cell", 0.1)
    assert "rugosity" in ran.out
    assert "compare dives on the same --cell" in ran.out


@pytest.mark.parametrize(
    ("text", "point"),
    [
        ("120:640,360.5", Pixel(120, 640.0, 360.5)),
        ("1,-0.5,9", MapPoint(1.0, -0.5, 9.0)),
        ("63.5N,10.25E", GeodeticPoint(63.5, 10.25)),
        ("63.5s, 10.25w", GeodeticPoint(-63.5, -10.25)),
    ],
)
def test_points_are_read_as_they_are_typed(text: str, point: object) -> None:
    assert parse_point(text) == point


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1,2",
        "1,2,3,4",
        "5:1,2,3",
        "x:1,2",
        "1,2,nan",
        "91N,0E",
        "1.2.3N,4E",
        "5:6:7,8",
        "a" * 200,
    ],
)
def test_what_is_no_point_is_refused(text: str) -> None:
    with pytest.raises(ArgumentError, match="is no point"):
        parse_point(text)


ENDS = ("--point", "1,1,9.9", "--point", "2,2,9.9")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--point", "1,1,9.9"), "2 points at least"),
        (("--point", "100,100,9.9", "--point", "1,1,9.9"), "the map has nothing at 100,100,9.9"),
        (("--point", "99:1,1", "--point", "0:1,1"), "frame 99 of .* was not mapped"),
        (("--point", "0:1000,1", "--point", "0:1,1"), "outside of the mapped picture"),
        (("--point", "10.0N,10.0E", "--point", "63.0N,10.0E"), "no ground at"),
        ((*ENDS, "--point", "1,2,9.9", "--as", "profile"), "between 2 points"),
        ((*ENDS, "--cell", "nan"), "--cell nan is no size"),
        ((*ENDS, "--csv", "clip.mp4"), "does not end in .csv"),
        (("--as", "line"), "need points"),
        (("--note", "text"), "need points"),
    ],
)
def test_what_cannot_be_measured_is_one_sentence(
    options: tuple[str, ...], sentence: str, dive: Path, command: Cli
) -> None:
    ran = command("measure", dive, *options)
    assert ran.code == (
        MISUSED if sentence.endswith((" no size", ".csv", "need points")) else FAILED
    )
    assert len(ran.err.strip().splitlines()) == 1
    assert re.search(sentence, ran.err)


def test_a_dive_that_has_no_place_on_the_earth_says_so(tmp_path: Path, command: Cli) -> None:
    frame = metric_frame(origin=None, north="initial heading")
    dive = write_survey(tmp_path / "dive", surveyed(frame), frame)
    ran = command("measure", dive, "--point", "63.43N,10.39E", "--point", "63.43N,10.4E")
    assert "no place on the earth" in ran.err


def test_a_folder_without_a_map_is_no_dive(tmp_path: Path, command: Cli) -> None:
    assert "holds no finished dive: map.aqf is missing" in command("measure", tmp_path).err


@pytest.fixture
def noted(dive: Path, tmp_path: Path) -> Path:
    """A dive with three notes."""
    copy = shutil.copytree(dive, tmp_path / "noted")
    frame = read_frame_of_map(copy / "map.aqf")
    ground = ground_n(CORNERS)
    notes = [
        Note("1", "wall", "LineString", ground[:2]),
        Note("7f2a", "sponge", "Point", ground[:1]),
        Note("3", "bed", "Polygon", ground),
    ]
    write_notes(copy, notes, frame)
    return copy


def test_notes_are_listed_with_their_keys(noted: Path, command: Cli) -> None:
    lines = command("measure", noted, "--notes").out.splitlines()
    assert [line.split() for line in lines] == [
        ["1", "line", "wall"], ["7f2a", "point", "sponge"], ["3", "area", "bed"],
    ]  # fmt: skip
    said = asked(command, noted, "--notes")
    assert said["unit"] == "m"
    assert [note["key"] for note in said["notes"]] == ["1", "7f2a", "3"]
    assert np.allclose(said["notes"][2]["places"], ground_n(CORNERS), atol=1e-3)


def test_notes_are_deleted_by_their_keys_and_the_others_stay(noted: Path, command: Cli) -> None:
    ran = command("measure", noted, "--delete", "7f2a", "--delete", "3")
    assert (ran.code, ran.out.split()) == (0, ["1", "line", "wall"])
    assert command("measure", noted, "--delete", "1").out.strip() == "The dive has no notes."


def test_a_key_that_no_note_has_deletes_none(noted: Path, command: Cli) -> None:
    ran = command("measure", noted, "--delete", "1", "--delete", "9")
    assert ran.code != 0
    assert "no note '9'" in ran.err
    assert len(read_notes(noted, read_frame_of_map(noted / "map.aqf"))) == 3


def test_tending_notes_measures_nothing(noted: Path, command: Cli) -> None:
    ran = command("measure", noted, "--notes", "--point", "0,0,0")
    assert ran.code != 0
    assert "measure nothing" in ran.err
