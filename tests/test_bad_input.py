"""Bad input through the real command line: one sentence that names it, and no traceback."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import QUICK, Cli, Ran

USAGE = 2
"""Exit code of an option that does not exist or is out of range."""


def refused(ran: Ran, *named: object) -> None:
    """The command failed with one sentence that names the input."""
    assert ran.code == 1
    assert ran.out == ""
    assert "Traceback" not in ran.err
    (line,) = ran.err.splitlines()
    assert line.startswith("aquaflow: ")
    for name in named:
        assert str(name) in line


def rows(dive: Path) -> list[dict[str, str]]:
    with (dive / "frames.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def pictures(recording: Path) -> list[Path]:
    return sorted((recording / "images").glob("*.png"))


def write_video(path: Path, codec: str, recording: Path) -> None:
    frames = [cv2.imread(str(file)) for file in pictures(recording)]
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10.0, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()


def cut(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


# --- recordings that cannot be opened -----------------------------------------------------------


def make_nothing(_path: Path) -> None:
    """Leave the path empty."""


def make_text(path: Path) -> None:
    path.write_text("this is no video\n" * 50)


def make_empty_file(path: Path) -> None:
    path.touch()


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("missing.mp4", make_nothing),
        ("text.mp4", make_text),
        ("empty.mp4", make_empty_file),
        ("notes.txt", make_text),
        ("folder", Path.mkdir),
    ],
)
def test_what_is_no_recording_is_refused(
    aquaflow: Cli, tmp_path: Path, name: str, make: Callable[[Path], None]
) -> None:
    source, out = tmp_path / name, tmp_path / "out"
    make(source)
    refused(aquaflow("map", source, "--out", out), source)
    assert not out.exists()


def test_a_video_cut_before_its_index_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source = tmp_path / "cut.mp4"
    write_video(source, "mp4v", small_recording)
    cut(source, 0.7)
    refused(aquaflow("map", source, "--out", tmp_path / "out"), source)


def test_a_video_that_ends_early_is_mapped_as_far_as_it_goes(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source, dive = tmp_path / "cut.avi", tmp_path / "out"
    write_video(source, "MJPG", small_recording)
    cut(source, 0.7)
    calibration = small_recording / "camera.yaml"
    ran = aquaflow("map", source, "--calib", calibration, "--out", dive, *QUICK)
    assert ran.code == 0
    assert "ends after" in ran.out
    assert "ends after" in (dive / "report.html").read_text()
    assert 10 < len(rows(dive)) < len(pictures(small_recording))


# --- recordings that hold something else than expected -------------------------------------------


def test_pictures_of_another_size_are_left_out_and_named(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source, dive = tmp_path / "mixed", tmp_path / "out"
    shutil.copytree(small_recording / "images", source)
    shutil.copy(small_recording / "camera.yaml", source)
    odd = pictures(small_recording)[5].name
    cv2.imwrite(str(source / odd), np.zeros((60, 80, 3), np.uint8))
    ran = aquaflow("map", source, "--out", dive, *QUICK)
    assert ran.code == 0
    assert "1 of 24 pictures were left out" in ran.out
    (left_out,) = [row for row in rows(dive) if row["class"] == "dropped"]
    assert left_out["source"] == odd
    assert "80 x 60" in left_out["reason"]
    assert odd in (dive / "report.html").read_text()


def test_a_black_clip_gives_no_map(aquaflow: Cli, tmp_path: Path) -> None:
    source, out = tmp_path / "black", tmp_path / "out"
    source.mkdir()
    for i in range(12):
        cv2.imwrite(str(source / f"{i}.png"), np.zeros((120, 160, 3), np.uint8))
    refused(aquaflow("map", source, "--out", out), source.name)
    assert all(row["reason"] for row in rows(out))


def test_a_clip_of_three_frames_is_mapped_or_refused_with_its_name(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source, out = tmp_path / "three", tmp_path / "out"
    source.mkdir()
    for file in pictures(small_recording)[:3]:
        shutil.copy(file, source)
    ran = aquaflow("map", source, "--out", out, *QUICK)
    if ran.code == 0:
        assert json.loads((out / "metrics.json").read_text())["tracked"] == 3
    else:
        refused(ran, source.name)
    assert len(rows(out)) == 3


def test_a_clip_of_two_frames_is_too_short(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    ran = aquaflow("map", small_recording, "--stop", 2, *QUICK, "--out", tmp_path / "out")
    refused(ran, small_recording.name, "at least 3")


def test_a_range_without_frames_says_so(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    ran = aquaflow("map", small_recording, "--start", 500, "--out", tmp_path / "out")
    refused(ran, small_recording.name, "500", "24 frames")


# --- options and files beside the recording -------------------------------------------------------


@pytest.mark.parametrize("crop", ["100,0,100,120", "0,0,0,0", "middle", "1,2,3", "-1,0,20,20"])
def test_a_crop_that_does_not_fit_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path, crop: str
) -> None:
    ran = aquaflow("map", small_recording, f"--crop={crop}", "--out", tmp_path / "out")
    refused(ran, crop)


def test_a_misspelt_key_of_a_calibration_is_named(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text((small_recording / "camera.yaml").read_text().replace("fx:", "focal_x:"))
    ran = aquaflow("map", small_recording, "--calib", file, "--out", tmp_path / "out")
    refused(ran, file, "focal_x")


def test_a_calibration_of_another_shape_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    file = tmp_path / "camera.yaml"
    text = (small_recording / "camera.yaml").read_text()
    file.write_text(text.replace("width: 160", "width: 320"))
    ran = aquaflow("map", small_recording, "--calib", file, "--out", tmp_path / "out")
    refused(ran, "320 x 120", "160 x 120")


def test_a_missing_calibration_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    file = tmp_path / "none.yaml"
    refused(aquaflow("map", small_recording, "--calib", file, "--out", tmp_path / "out"), file)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("mapping:\n  optimiser:\n    refine_stepz: 5\n", "mapping.optimiser.refine_stepz"),
        ("source:\n  every: 0\n", "source.every"),
        ("- a\n- b\n", "key: value"),
        ("a: [1,\n", "not YAML"),
    ],
)
def test_a_bad_config_is_refused_with_the_keys_path(
    aquaflow: Cli, small_recording: Path, tmp_path: Path, text: str, named: str
) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(text)
    ran = aquaflow("map", small_recording, "--config", file, "--out", tmp_path / "out")
    refused(ran, file, named)


@pytest.mark.parametrize(
    ("option", "value"), [("every", 0), ("width", 3), ("fps", 0), ("stop", 0), ("threads", 0)]
)
def test_an_option_out_of_range_is_refused_by_its_name(
    aquaflow: Cli, small_recording: Path, tmp_path: Path, option: str, value: int
) -> None:
    ran = aquaflow("map", small_recording, f"--{option}", value, "--out", tmp_path / "out")
    refused(ran, option)
    assert not (tmp_path / "out").exists()


def test_an_unknown_option_is_a_usage_error(aquaflow: Cli, tmp_path: Path) -> None:
    ran = aquaflow("map", tmp_path, "--evry", 2)
    assert ran.code == USAGE
    assert "--evry" in ran.err
    assert "Traceback" not in ran.err


@pytest.mark.parametrize(
    ("option", "value"), [("scene", "moon"), ("water", "milk"), ("frames", 1), ("seed", -1)]
)
def test_a_synthetic_dive_that_does_not_exist_is_refused(
    aquaflow: Cli, tmp_path: Path, option: str, value: object
) -> None:
    refused(aquaflow("synth", tmp_path / "s", f"--{option}", value), f"--{option}")


# --- folders to write to and to read from ---------------------------------------------------------


def test_a_folder_with_other_files_is_not_written_to(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    for extra in ((), ("--overwrite",)):
        refused(aquaflow("map", small_recording, "--out", tmp_path, *extra), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_an_out_that_is_a_file_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    refused(aquaflow("map", small_recording, "--out", file), file)
    assert file.read_text() == "x"


def test_a_dive_is_not_replaced_unasked(
    aquaflow: Cli, small_recording: Path, small_dive: Path
) -> None:
    before = (small_dive / "trajectory.tum").read_bytes()
    refused(aquaflow("map", small_recording, "--out", small_dive), small_dive, "--overwrite")
    assert (small_dive / "trajectory.tum").read_bytes() == before


def test_a_dive_is_not_written_over_the_recording(aquaflow: Cli, small_recording: Path) -> None:
    refused(aquaflow("map", small_recording, "--out", small_recording), small_recording)


def test_evaluate_needs_something_to_compare_with(aquaflow: Cli, small_dive: Path) -> None:
    refused(aquaflow("evaluate", small_dive), "--truth")


def test_evaluate_refuses_a_folder_that_is_no_dive(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    for folder in (tmp_path / "none", tmp_path):
        refused(aquaflow("evaluate", folder, "--truth", small_recording), folder)
        refused(aquaflow("evaluate", folder, "--clean", small_recording), folder)


def test_evaluate_refuses_a_truth_that_is_none(
    aquaflow: Cli, small_dive: Path, tmp_path: Path
) -> None:
    truth = tmp_path / "truth.tum"
    refused(aquaflow("evaluate", small_dive, "--truth", truth), truth)
    truth.write_text("0.0 1 2 three 0 0 0 1\n")
    refused(aquaflow("evaluate", small_dive, "--truth", truth), truth)
