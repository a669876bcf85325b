"""The viewer's page: a finished dive, browsers that hang, notes and the scale bar."""

from __future__ import annotations

import json
import shutil
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.dive import Dive
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer.finished import finished_dive, open_dive
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.survey.viewer.seen_water import water_of
from aquaflow.survey.viewer.splats import splats
from aquaflow.survey.viewer.tools import PinnedNotes, SavedViewpoints, Tools
from aquaflow.telemetry.metric_file import write_metric_file
from aquaflow.telemetry.world_frame import WorldFrame
from tests.metric_scenes import metric_frame
from tests.small_recording import HEIGHT, WIDTH


@pytest.fixture
def page() -> Iterator[ViewerPage]:
    page = ViewerPage(ViewerConfig(port=0), "test")
    yield page
    page.close()


@pytest.fixture
def dive(small_dive: Path, tmp_path: Path) -> Path:
    """A copy that may be changed."""
    return shutil.copytree(small_dive, tmp_path / "dive")


def many(count: int, brightness: float) -> Any:
    rng = np.random.default_rng(0)
    return splats(
        rng.normal(size=(count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        np.full((count, 3), 0.05, np.float32),
        np.full(count, 0.9, np.float32),
        np.full((count, 3), brightness, np.float32),
        count,
    )


def test_a_browser_that_never_reads_does_not_hold_up_who_shows(page: ViewerPage) -> None:
    port = int(page.address.rstrip("/").rpartition(":")[2])
    camera, picture = guess_camera(WIDTH, HEIGHT), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    page.show_splats(many(60_000, 0.5))
    version = page._exhibit.scene()["map"]["version"]
    hung = socket.create_connection(("127.0.0.1", port), timeout=20)
    wanted = "".join(
        f"GET /map/{version}/{number % 2} HTTP/1.1\r\nHost: localhost\r\n\r\n"
        for number in range(40)
    )
    hung.sendall(wanted.encode())  # 20 MB: far beyond what a socket's buffers take
    for turn in range(10):
        page.show_splats(many(20_000, turn / 10))
        page.show_camera(Sim3.identity(), camera, picture)
        page.show_path(np.ones((turn + 2, 8), np.float32))
        page.show_health(f"turn {turn}")
    assert page.splats_shown == 20_000
    hung.close()


def test_a_finished_dive_is_read_with_its_colours_poses_and_pictures(small_dive: Path) -> None:
    dive = finished_dive(Dive(small_dive), budget=500)
    assert len(dive.splats) == 500
    assert set(dive.splats.levels) == set(dive.palettes) == {"range", "coverage"}
    assert len(dive.path.poses) == len(dive.path.quality) == len(dive.path.moments)
    held_out = {int(path.name[:6]) for path in (small_dive / "heldout").glob("*_real.png")}
    kept = {int(path.stem) for path in (small_dive / "pictures").glob("*.jpg")}
    assert held_out
    assert kept
    assert set(dive.path.pictures) == held_out | kept
    assert set(dive.path.moments[:, 3].astype(int)) <= held_out | kept


def test_the_water_of_a_dive_is_read_and_a_damaged_one_costs_itself(dive: Path) -> None:
    rates = {"B_inf": [0.1, 0.2, 0.3], "b": [0.3] * 3, "B_res": [0.0] * 3, "d": [0.3] * 3}
    medium = {
        "active": True, "attenuation_per_unit": [0.5, 0.2, 0.2], "backscatter": rates,
        "restored": {"gain": [1.0, 1.0, 1.0]}, "map_ply_reference_range": 2.5,
    }  # fmt: skip
    (dive / "medium.json").write_text(json.dumps(medium))
    water = finished_dive(Dive(dive), budget=50).water
    assert water is not None
    assert (water.beta, water.range) == ((0.5, 0.2, 0.2), 2.5)
    for damage in ("{", json.dumps(medium | {"backscatter": None}), "[]"):
        (dive / "medium.json").write_text(damage)
        assert finished_dive(Dive(dive), budget=50).water is None


def test_a_dive_is_shown_in_its_tone_whether_its_colours_have_it_or_not() -> None:
    rates = {"B_inf": [0.1, 0.2, 0.3], "b": [0.3] * 3, "B_res": [0.0] * 3, "d": [0.3] * 3}
    restored = {"gain": [0.5, 1.0, 2.0], "exposure": 1.5, "highlight_compression": 3.0}
    medium: dict[str, Any] = {
        "active": True, "attenuation_per_unit": [0.5, 0.2, 0.2], "backscatter": rates,
        "map_ply_reference_range": 2.5,
    }  # fmt: skip
    white = {"choice": "camera", "gain": [1.0] * 3, "sigma": None}
    now = water_of(medium | {"restored": restored | {"white_balance": white}})
    assert now is not None
    assert (now.gain, now.white) == ((0.75, 1.5, 3.0), (1.0, 1.0, 1.0))
    assert now.compression == now.shown_compression == 3.0
    before = water_of(medium | {"restored": restored | {"white_balance": "as the camera saw"}})
    assert before is not None
    assert (before.gain, before.white) == ((0.5, 1.0, 2.0), (1.5, 1.5, 1.5))
    assert (before.compression, before.shown_compression) == (0.0, 3.0)


def test_a_metric_dive_says_its_unit_and_has_its_z_axis_down(dive: Path) -> None:
    (dive / "metric.json").unlink()
    assert "map units" in finished_dive(Dive(dive), budget=50).summary
    write_metric_file(dive, {0: metric_frame()}, main=0)
    shown = finished_dive(Dive(dive), budget=50)
    assert "metres, \u00b1 0.4 %; x to true north, y to the right of it, z down" in shown.summary
    page = open_dive(dive, ViewerConfig(port=0, splats=100))
    try:
        scene = page._exhibit.scene()
    finally:
        page.close()
    assert (scene["up"], scene["unit"]) == ((0.0, 0.0, -1.0), "m")


def test_a_damaged_line_of_the_frames_costs_itself(small_dive: Path, dive: Path) -> None:
    header, *lines = (dive / "frames.csv").read_text().splitlines()
    lines[5] = lines[5].replace("0.", "0g.")
    (dive / "frames.csv").write_text("\n".join([header, "x", ",1e999,,,", *lines]))
    damaged, whole = (
        finished_dive(Dive(dive), budget=50),
        finished_dive(Dive(small_dive), budget=50),
    )
    assert len(damaged.path.poses) == len(whole.path.poses)
    assert (damaged.path.quality != whole.path.quality).sum() <= 1


@pytest.mark.parametrize(
    "line", ["1 2 3", "0 0 0 0 0 0 0 0", "0 nan 0 0 0 0 0 1", "0 x 0 0 0 0 0 1"]
)
def test_a_trajectory_that_holds_no_poses_is_refused(dive: Path, line: str) -> None:
    (dive / "trajectory.tum").write_text(f"{line}\n")
    with pytest.raises(InputError, match=r"trajectory\.tum"):
        finished_dive(Dive(dive), budget=50)


def test_a_folder_without_a_dive_is_refused_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"map\.ply is missing"):
        finished_dive(Dive(tmp_path), budget=500)


# --- what a browser leaves in a dive ------------------------------------------------------------


def test_notes_are_kept_in_the_dive_and_removed(dive: Path) -> None:
    ask = Tools(others=PinnedNotes(dive).tools()).ask
    assert ask("notes/list", {}) == {"notes": []}
    kept = ask("notes/add", {"text": " a wreck ", "shape": "Point", "places": [[1, 2, 3]]})
    again = Tools(others=PinnedNotes(dive).tools()).ask
    first = again("notes/list", {})["notes"][0]
    assert (first["text"], first["places"]) == ("a wreck", [[1.0, 2.0, 3.0]])
    assert json.loads((dive / "notes.geojson").read_text())["type"] == "FeatureCollection"
    quantity = {"value": 1.5, "sigma": 0.1, "low_95": 1.3, "high_95": 1.7, "unit": "m"}
    line = {"text": "line", "shape": "LineString", "places": [[1, 2, 3], [2, 2, 3]]}
    ask("notes/add", line | {"measured": {"distance": quantity}})
    assert "1.5" in (dive / "notes.geojson").read_text()
    again("notes/remove", {"key": kept["key"]})
    assert [note["text"] for note in again("notes/list", {})["notes"]] == ["line"]
    with pytest.raises(InputError, match="no such note"):
        again("notes/remove", {"key": kept["key"]})


def test_views_are_kept_in_the_dive_and_removed(dive: Path) -> None:
    ask = Tools(others=SavedViewpoints(dive).tools()).ask
    assert ask("viewpoints/list", {}) == {"viewpoints": []}
    link = "at=1,2,-3.5&to=0,0,1&water=40&colours=coverage&all=1&crop=,,-1,,2,"
    kept = ask("viewpoints/add", {"name": " bow ", "link": link})
    ask("viewpoints/add", {"name": "start", "link": "pose=0"})
    found = Tools(others=SavedViewpoints(dive).tools()).ask("viewpoints/list", {})["viewpoints"]
    assert [(each["name"], each["link"]) for each in found] == [("bow", link), ("start", "pose=0")]
    assert json.loads((dive / "viewpoints.json").read_text())["viewpoints"][0]["water"] == 40.0
    ask("viewpoints/remove", {"key": kept["key"]})
    assert [each["name"] for each in ask("viewpoints/list", {})["viewpoints"]] == ["start"]
    with pytest.raises(InputError, match="no such view"):
        ask("viewpoints/remove", {"key": kept["key"]})


@pytest.mark.parametrize(
    "bad",
    [
        {"name": ""}, {"name": 5}, {"name": "x" * 101}, {"link": None}, {"link": ""},
        {"link": "at=1,2&to=0,0,0"}, {"link": "at=1,2,nan&to=0,0,0"}, {"link": "pose=-1"},
        {"link": "pose=0&water=900"}, {"link": "pose=0&crop=1,2"}, {"link": "pose=0&colours=<b>"},
        {"link": "pose=x"}, {"link": "at=1,2,3"},
    ],
)  # fmt: skip
def test_what_is_no_view_is_refused_and_changes_nothing(dive: Path, bad: dict[str, Any]) -> None:
    tools = Tools(others=SavedViewpoints(dive).tools())
    with pytest.raises(InputError):
        tools.ask("viewpoints/add", {"name": "x", "link": "pose=0"} | bad)
    assert not (dive / "viewpoints.json").exists()


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"unit": "furlong", "viewpoints": []}', '{"viewpoints": [5]}']
)
def test_a_file_that_holds_no_views_is_refused_and_left(dive: Path, text: str) -> None:
    (dive / "viewpoints.json").write_text(text)
    tools = Tools(others=SavedViewpoints(dive).tools())
    with pytest.raises(InputError, match="correct or remove it"):
        tools.ask("viewpoints/add", {"name": "x", "link": "pose=0"})
    assert (dive / "viewpoints.json").read_text() == text


@pytest.mark.parametrize(
    "bad",
    [
        {"text": ""}, {"text": 5}, {"text": "x" * 1001}, {"shape": "Circle"}, {"shape": []},
        {"places": []}, {"places": [[1, 2]]}, {"places": "here"}, {"places": [[1, 2, None]]},
        {"shape": "Polygon"}, {"places": [[0, 0, 0]] * 2000},
        {"measured": {"x": 5}}, {"measured": {"x": {"value": "1"}}},
        {"measured": {str(n): {} for n in range(9)}},
    ],
)  # fmt: skip
def test_what_is_no_note_is_refused_and_changes_nothing(dive: Path, bad: dict[str, Any]) -> None:
    note = {"text": "x", "shape": "Point", "places": [[1, 2, 3]]} | bad
    with pytest.raises(InputError):
        Tools(others=PinnedNotes(dive).tools()).ask("notes/add", note)
    assert not (dive / "notes.geojson").exists()


def test_a_scale_bar_reaches_the_dive_and_the_page_shows_the_new_unit(dive: Path) -> None:
    (dive / "metric.json").unlink()
    asked: list[Any] = []

    def mark(ends: Any, length_m: float, sigma_m: float) -> tuple[str, bool]:
        asked.append((ends, length_m, sigma_m))
        write_metric_file(dive, {0: metric_frame()}, main=0)
        return "1 map unit is 2 m", True

    page = open_dive(dive, ViewerConfig(port=0, splats=100), mark)
    try:
        before = page._exhibit.scene()
        given = {"places": [[0, 0, 1], [1, 0, 1]], "length_m": 2.0, "sigma_m": 0.01}
        said = page._tools.ask("scale", given)
        after = page._exhibit.scene()
    finally:
        page.close()
    assert asked == [(((0.0, 0.0, 1.0), (1.0, 0.0, 1.0)), 2.0, 0.01)]
    assert said == {"words": "1 map unit is 2 m", "rescaled": True}
    assert before["can"] == ("note", "view", "scale")
    assert (before["unit"], after["unit"]) == ("map units", "m")


def test_points_on_something_level_reach_the_dive_and_turn_the_page(dive: Path) -> None:
    (dive / "metric.json").unlink()
    write_metric_file(dive, {0: WorldFrame.unknown()}, main=0)
    asked: list[Any] = []

    def turn(places: Any) -> str:
        asked.append(places)
        write_metric_file(dive, {0: metric_frame()}, main=0)
        return "The vertical is known"

    page = open_dive(dive, ViewerConfig(port=0, splats=100), None, None, turn)
    try:
        before = page._exhibit.scene()
        for bad in ({}, {"places": [[0, 0, 1]] * 2}, {"places": [[0, 0, None]] * 3}):
            with pytest.raises(InputError):
                page._tools.ask("level", bad)
        said = page._tools.ask("level", {"places": [[0, 0, 1], [1, 0, 1], [0, 1, 1]]})
        after = page._exhibit.scene()
    finally:
        page.close()
    assert asked == [[(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)]]
    assert said == {"words": "The vertical is known"}
    assert before["can"] == ("note", "view", "level")
    assert before["up"] != after["up"]


def test_a_dive_whose_gravity_was_measured_offers_no_level(dive: Path) -> None:
    write_metric_file(dive, {0: metric_frame()}, main=0)
    page = open_dive(dive, ViewerConfig(port=0, splats=100), None, None, lambda _: "turned")
    try:
        assert page._exhibit.scene()["can"] == ("note", "view")
    finally:
        page.close()


@pytest.mark.parametrize(
    "bad", [{"places": [[0, 0, 1]]}, {"length_m": 0}, {"length_m": "2"}, {"sigma_m": float("nan")}]
)
def test_a_scale_bar_that_is_none_is_refused(dive: Path, bad: dict[str, Any]) -> None:
    page = open_dive(dive, ViewerConfig(port=0, splats=100), lambda *_: pytest.fail("it was kept"))
    given = {"places": [[0, 0, 1], [1, 0, 1]], "length_m": 2.0, "sigma_m": 0.01} | bad
    try:
        with pytest.raises(InputError):
            page._tools.ask("scale", given)
    finally:
        page.close()


def test_browsers_are_answered_one_at_a_time(page: ViewerPage, monkeypatch: Any) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow(_: dict[str, Any]) -> dict[str, Any]:
        begun.set()
        go_on.wait(60.0)
        return {}

    monkeypatch.setattr("aquaflow.survey.viewer.tools.BUSY_S", 0.01)
    page._tools.others["slow"] = slow
    first = threading.Thread(target=page._tools.ask, args=("slow", {}))
    first.start()
    begun.wait(60.0)
    with pytest.raises(InputError, match="busy"):
        page._tools.ask("slow", {})
    go_on.set()
    first.join()
    assert page._tools.ask("slow", {}) == {}
