"""``aquaflow measure scale`` brings the files of a dive without metres to metres."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import read_ply
from aquaflow.dive.trajectory_csv import read_trajectory_csv
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.coverage_file import read_coverage_file
from aquaflow.survey.measure import finished_dive
from aquaflow.survey.measure.finished_dive import numbers_of_dive
from aquaflow.survey.measure.notes import Note, read_notes, write_notes
from aquaflow.survey.measure.reframing import reframe
from aquaflow.survey.measure.scale_bar import keep_length
from aquaflow.survey.report.report_of import report_of
from aquaflow.telemetry.known_lengths.known_length import KnownLength
from aquaflow.telemetry.metric_file import read_metric_file, write_metric_file
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.mounting import Lamp
from tests.command_line import Cli, refused
from tests.metric_scenes import metric_frame

LENGTH = ("--from", "0,0,1", "--to", "0,0.5,1", "--length", 1.5)
"""1.5 m are half a map unit."""


LAMP = Lamp(0.8, 2.0, 1.5, 0.05, ((-0.2, -0.1), (0.2, -0.1)), (0.03, 0.02))


@pytest.fixture
def dive(small_dive: Path, tmp_path: Path) -> Path:
    """Of which nothing has measured the scale."""
    folder = Path(shutil.copytree(small_dive, tmp_path / "dive"))
    write_metric_file(folder, {0: WorldFrame.unknown()}, main=0)
    medium = json.loads((folder / "medium.json").read_text())
    (folder / "medium.json").write_text(json.dumps(medium | {"lamp": asdict(LAMP)}))
    return folder


def numbers(dive: Path) -> dict[str, Any]:
    """Everything in the dive that has a length in it."""
    water = json.loads((dive / "medium.json").read_text())
    clear = read_ply(dive / "map_clear.ply")
    seen = read_coverage_file(dive / "coverage.npz")[0]
    coverage = {"scale": seen.scale, "swath": seen.state.swath}
    ranges = sorted((dive / "heldout").glob("*_range.npz"))
    return {
        "tum": np.loadtxt(dive / "trajectory.tum")[:, 1:4],
        "csv": np.array([(r.x, r.y, r.z) for r in read_trajectory_csv(dive / "trajectory.csv")]),
        "means": read_ply(dive / "map.ply").means,
        "scales": clear.scales,
        "held out": np.concatenate([np.load(path)["z"].ravel() for path in ranges]),
        "ranges": np.array([water["range_p5"], water["map_ply_reference_range"]]),
        "lamp": np.array([water["lamp"]["range"], *np.ravel(water["lamp"]["places"])]),
        "coverage": np.array([coverage["scale"], coverage["swath"]]),
        "path per rate": 1.0 / np.array(water["attenuation_per_unit"]),
        "path per b": 1.0 / np.array(water["backscatter"]["b"]),
    }


def assert_scaled(dive: Path, before: dict[str, Any], times: float) -> None:
    for name, after in numbers(dive).items():
        np.testing.assert_allclose(after, times * before[name], rtol=1e-3, atol=2e-5, err_msg=name)


def test_every_file_is_in_metres_after_a_length_was_marked(dive: Path, command: Cli) -> None:
    before = numbers(dive)
    ran = command("measure", "scale", dive, *LENGTH)
    assert ran.code == 0, ran.err
    assert "in metres now" in ran.out
    assert_scaled(dive, before, 3.0)
    frame = read_metric_file(dive)[0]
    assert frame.metric
    assert frame.scale_source.startswith("known length 'scale bar")
    metrics = json.loads((dive / "metrics.json").read_text())
    assert (metrics["unit"], metrics["telemetry"][-1]["kind"]) == ("m", "length")
    assert metrics["scale_sigma"] == pytest.approx(frame.scale_sigma)
    assert json.loads((dive / "medium.json").read_text())["attenuation_unit"] == "1/m"
    assert "unit: m" in (dive / "trajectory.tum").read_text().splitlines()[0]
    rows = read_trajectory_csv(dive / "trajectory.csv")
    assert {row.unit for row in rows} == {"m"}
    moved = np.linalg.norm(np.diff(3.0 * before["tum"], axis=0), axis=1).sum()
    assert np.mean([row.speed_m_s or 0.0 for row in rows]) == pytest.approx(
        moved / rows[-1].t_s, rel=0.15
    )


def test_a_length_that_is_marked_anew_replaces_the_scale(dive: Path, command: Cli) -> None:
    before = numbers(dive)
    command("measure", "scale", dive, *LENGTH)
    # In the metres of the first time, the same two ends of the map.
    again = ("--from", "0,0,3", "--to", "0,1.5,3", "--length", 1.6)
    said = json.loads(command("measure", "scale", dive, *again, "--json").out)
    assert said["rescaled"]
    assert_scaled(dive, before, said["all_metres_per_unit"])
    assert said["all_metres_per_unit"] == pytest.approx(3.1, abs=0.05)


def test_the_ground_is_measured_anew_in_metres_and_in_the_report(
    small_dive: Path, tmp_path: Path, command: Cli
) -> None:
    dive = Path(shutil.copytree(small_dive, tmp_path / "level"))
    known = read_metric_file(dive)[0]
    reframe(Dive(dive), 0, replace(known, T_nm=Sim3(known.T_nm.R, np.zeros(3)), metric=False))
    numbers_before = numbers_of_dive(Dive(dive), tmp_path)
    assert numbers_before.missing["lengths and areas"].startswith("the dive has no metres")
    assert not {"surveyed_area", "path_length"} & {each.key for each in numbers_before.numbers}
    ran = command("measure", "scale", dive, *LENGTH)
    assert ran.code == 0, ran.err
    content = json.loads((dive / "reef_numbers.json").read_text())
    assert content["unit"] == "m"
    rows = [r for r in read_trajectory_csv(dive / "trajectory.csv") if r.sub_map == 0]
    way = np.linalg.norm(np.diff([(r.x, r.y, r.z) for r in rows], axis=0), axis=1).sum()
    path = content["numbers"]["path_length"]
    assert path["value"] == pytest.approx(way, rel=1e-3)
    scale_sigma = read_metric_file(dive)[0].scale_sigma
    assert path["high_95"] - path["value"] == pytest.approx(1.96 * scale_sigma * way, rel=0.01)
    assert "m\u00b2" in (dive / "reef_numbers.csv").read_text()
    shown = {row.label: row.value for row in report_of(Dive(dive)).reef}
    assert shown["length of the path"].endswith(" m")
    assert shown["surveyed area"].endswith(" m\u00b2")


def test_numbers_of_the_ground_that_cannot_be_measured_anew_are_taken_away(
    dive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise InputError("no two views of the dive see the same ground")

    monkeypatch.setattr(finished_dive, "numbers_of_dive", fails)
    known = KnownLength(-1, "ruler", 0.5, 0.005, 1.5, 0.001, 0)
    assert keep_length(dive, known).unchanged is None
    assert not list(dive.glob("reef_numbers.*"))
    assert report_of(Dive(dive)).reef == []


def test_notes_stay_where_they_are_in_the_map(dive: Path, command: Cli) -> None:
    place = np.array([[0.5, -0.25, 2.0]])
    write_notes(dive, [Note("a", "crack", "Point", place)], WorldFrame.unknown())
    assert command("measure", "scale", dive, *LENGTH).code == 0
    [note] = read_notes(dive, read_metric_file(dive)[0])
    np.testing.assert_allclose(note.places, 3.0 * place)


def test_a_dive_that_is_metric_already_keeps_its_metres(dive: Path, command: Cli) -> None:
    write_metric_file(dive, {0: metric_frame()}, main=0)
    before = numbers(dive)
    ran = command("measure", "scale", dive, *LENGTH)
    assert "keep the metres of bar30, compass; the marked lengths say +200.0 %" in ran.out
    assert_scaled(dive, before, 1.0)


def test_a_dive_without_metric_file_keeps_its_unit(dive: Path, command: Cli) -> None:
    (dive / "metric.json").unlink()
    assert "no metric.json" in command("measure", "scale", dive, *LENGTH).out


def test_a_damaged_file_is_named_and_none_is_changed(dive: Path, command: Cli) -> None:
    (dive / "trajectory.tum").write_text("1 2 three\n")
    before = (dive / "map.ply").read_bytes()
    refused(command("measure", "scale", dive, *LENGTH), "trajectory.tum")
    assert (dive / "map.ply").read_bytes() == before
