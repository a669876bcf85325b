"""``aquaflow measure scale``: a marked length of a finished dive gives the metres of a map unit."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config import Config
from aquaflow.dive.dive import Dive
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.frames_csv import read_rows
from aquaflow.geometry.alignment import align
from aquaflow.geometry.camera import load_camera
from aquaflow.lab.evaluation.trajectory_error import associate, read_tum
from aquaflow.survey.measure.scale_bar import between_pixels, between_points
from aquaflow.telemetry.known_lengths.known_length import (
    FILE,
    KnownLength,
    read_known_lengths,
    with_length,
    write_known_lengths,
)
from aquaflow.telemetry.metric_file import read_frame_of_map, write_metric_file
from tests.command_line import Cli
from tests.metric_scenes import SCALE, metric_frame


@pytest.fixture
def dive(small_dive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_dive, tmp_path / "dive"))


def mapped_frame(dive: Path) -> int:
    """A keyframe in the middle of the dive."""
    keyframes = [
        row.index for row in read_rows(dive / "frames.csv") if row.frame_class == "keyframe"
    ]
    return keyframes[len(keyframes) // 2]


def ends(camera_width: int, camera_height: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two points across the picture."""
    return (0.25 * camera_width, 0.55 * camera_height), (0.8 * camera_width, 0.6 * camera_height)


def true_length_m(recording: Path, frame: int, size: tuple[int, int]) -> float:
    """Between the same points, by the recording's own ranges."""
    camera = load_camera(recording / "camera.yaml")
    ranges = np.load(recording / "range" / f"{frame:06d}.npz")["range_m"]
    places = []
    for u, v in ends(*size):
        pixel = np.array([u * camera.width / size[0], v * camera.height / size[1]])
        ray = camera.unproject(pixel)
        places.append(ray / np.linalg.norm(ray) * ranges[int(pixel[1]), int(pixel[0])])
    return float(np.linalg.norm(places[1] - places[0]))


def test_a_length_in_a_picture_gives_the_scale_that_the_path_has(
    dive: Path, small_recording: Path
) -> None:
    frame, camera = mapped_frame(dive), load_camera(dive / "camera.yaml")
    size = (camera.width, camera.height)
    metres = true_length_m(small_recording, frame, size)
    known = between_pixels(Dive(dive), frame, *ends(*size), metres, 0.001)
    found, true = read_tum(dive / "trajectory.tum"), read_tum(small_recording / "poses.tum")
    mine, theirs = associate(found.t_s, true.t_s)
    aligned = align(found.positions[mine], true.positions[theirs], with_scale=True)
    of_the_map = read_frame_of_map(dive / "map.aqf").T_nm.scale  # 1 where it keeps its unit
    error = np.log(known.metres_per_unit / (aligned.T_target_source.scale * of_the_map))
    assert abs(error) < 0.1
    assert abs(error) < 4.0 * known.relative_sigma


def test_the_command_prints_metres_with_plus_minus_and_keeps_them(dive: Path, command: Cli) -> None:
    frame = mapped_frame(dive)
    pixels = ("measure", "scale", dive, "--frame", frame, "--from", "40,60", "--to", "120,70")
    ran = command(*pixels, "--length", 1.5)
    assert ran.code == 0, ran.err
    assert "1 map unit is" in ran.out
    assert " +- " in ran.out
    points = ("measure", "scale", dive, "--from", "0,0,1", "--to", "0.5,0,1")
    command(*points, "--length", 0.7, "--json")
    ran = command(*pixels, "--length", 1.5, "--sigma", 0.01, "--json")
    said = json.loads(ran.out)
    kept = json.loads((dive / FILE).read_text())
    assert [each["length_m"] for each in kept["lengths"]] == [0.7, 1.5]
    assert said["lengths"] == 2
    assert kept["scales"][0]["metres_per_unit"] == pytest.approx(said["all_metres_per_unit"])


def test_two_points_of_the_map_need_no_picture(dive: Path) -> None:
    (dive / "metric.json").unlink()
    known = between_points(Dive(dive), (0.0, 0.0, 1.0), (0.3, 0.4, 1.0), 1.0, 0.001)
    assert known.metres_per_unit == pytest.approx(2.0)
    assert known.frame_index == -1


def test_points_of_a_map_in_metres_are_taken_back_to_its_own_unit(dive: Path) -> None:
    write_metric_file(dive, {0: metric_frame()}, main=0)
    known = between_points(Dive(dive), (0.0, 0.0, 1.0), (0.3, 0.4, 1.0), 1.0, 0.001)
    assert known.metres_per_unit == pytest.approx(2.0 * SCALE)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--from", "1,2", "--to", "30,4"), "need --frame"),
        (("--frame", 0, "--from", "1,2,3", "--to", "4,5,6"), "leave out --frame"),
        (("--from", "1,2", "--to", "4,5,6"), "both be x,y"),
        (("--from", "a,b", "--to", "4,5"), "neither x,y"),
        (("--from", "nan,1", "--to", "4,5"), "neither x,y"),
        (("--from", "1,2,3", "--to", "1,2,3"), "one and the same"),
        (("--frame", 9999, "--from", "1,2", "--to", "30,4"), "has no pose"),
        (("--frame", 0, "--from", "1,2", "--to", "30,4", "--length", -1), "positive"),
        (("--frame", 0, "--from", "1,2", "--to", "30,4", "--sigma", "nan"), "positive"),
    ],
)
def test_points_that_cannot_be_measured_are_refused_in_a_sentence(
    arguments: tuple[object, ...], sentence: str, dive: Path, command: Cli
) -> None:
    length = () if "--length" in arguments else ("--length", 1.0)
    ran = command("measure", "scale", dive, *arguments, *length)
    assert ran.code != 0
    assert sentence in " ".join(ran.err.replace("│", " ").split())
    assert not (dive / FILE).exists()


def test_points_outside_or_too_near_or_in_the_open_water_are_refused(dive: Path) -> None:
    frame = mapped_frame(dive)
    with pytest.raises(InputError, match="outside"):
        between_pixels(Dive(dive), frame, (1.0, 1.0), (5000.0, 1.0), 1.0, 0.001)
    with pytest.raises(InputError, match="apart"):
        between_pixels(Dive(dive), frame, (50.0, 50.0), (52.0, 50.0), 1.0, 0.001)


def test_a_frame_that_was_not_mapped_names_the_nearest(dive: Path) -> None:
    rows = read_rows(dive / "frames.csv")
    (dive / "frames.csv").write_text(
        (dive / "frames.csv").read_text() + f"500,x,{rows[-1].t_s + 1},common,0,0,1.0,\n"
    )
    with pytest.raises(InputError, match="the nearest mapped one is"):
        between_pixels(Dive(dive), 500, (10.0, 10.0), (60.0, 60.0), 1.0, 0.001)


@pytest.mark.parametrize("content", ["{", "[]", '{"lengths": [{}]}', '{"lengths": 3}'])
def test_a_damaged_file_is_refused_and_kept(content: str, tmp_path: Path) -> None:
    (tmp_path / FILE).write_text(content)
    with pytest.raises(InputError, match="known lengths"):
        read_known_lengths(tmp_path)
    assert (tmp_path / FILE).read_text() == content


def test_lengths_are_read_as_written_and_sub_maps_have_scales_of_their_own(tmp_path: Path) -> None:
    lengths = [
        KnownLength(3, "marker 7", 0.5, 0.01, 0.16, 0.001, 0),
        KnownLength(9, "laser dots", 0.2, 0.01, 0.1, 0.001, 2),
    ]
    write_known_lengths(tmp_path, lengths)
    assert read_known_lengths(tmp_path) == lengths
    scales = json.loads((tmp_path / FILE).read_text())["scales"]
    assert [each["sub_map"] for each in scales] == [0, 2]
    assert read_known_lengths(tmp_path / "elsewhere") == []


def test_a_dive_mapped_anew_has_another_unit_and_none_of_the_lengths(tmp_path: Path) -> None:
    DiveFolder(tmp_path, Config()).close()
    write_known_lengths(tmp_path, [KnownLength(3, "marker 7", 0.5, 0.01, 0.16, 0.001)])
    DiveFolder(tmp_path, Config(), overwrite=True).close()
    assert read_known_lengths(tmp_path) == []


def test_the_same_length_measured_again_replaces_the_first() -> None:
    first = KnownLength(3, "marker 7", 0.5, 0.01, 0.16, 0.001)
    again = KnownLength(3, "marker 7", 0.6, 0.01, 0.16, 0.001)
    assert with_length([first], again) == [again]
