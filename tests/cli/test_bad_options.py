"""Bad options, bad files and bad folders through the real command line: one sentence each."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors.crash_report import FAILED, MISUSED
from tests.command_line import Cli, refused

# --- options and files beside the recording -------------------------------------------------------


@pytest.mark.parametrize(
    ("crop", "code"),
    [
        *((crop, MISUSED) for crop in ("0,0,0,0", "middle", "1,2,3", "-1,0,20,20")),
        ("100,0,100,120", FAILED),
    ],
)
def test_a_crop_that_fits_no_picture_or_not_this_one_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path, crop: str, code: int
) -> None:
    ran = aquaflow("map", small_recording, f"--crop={crop}", "--out", tmp_path / "out")
    refused(ran, crop, code=code)


def test_a_mask_that_is_no_picture_or_of_another_size_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    file = tmp_path / "mask.png"
    given = ("map", small_recording, "--mask", file, "--out")
    refused(aquaflow(*given, tmp_path / "1"), file)
    file.write_text("white")
    refused(aquaflow(*given, tmp_path / "2"), file, "no picture")
    cv2.imwrite(str(file), np.full((60, 80), 255, np.uint8))
    refused(aquaflow(*given, tmp_path / "3"), "80 x 60", "160 x 120")


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


def test_a_calibration_for_no_recording_is_refused(aquaflow: Cli, tmp_path: Path) -> None:
    vehicle = tmp_path / "vehicle.yaml"
    vehicle.write_text("cameras: {front: {kind: v4l2}}")
    ran = aquaflow("run", "--config", vehicle, "--calib", "camera.yaml")
    refused(ran, "camera.yaml", "--source", code=MISUSED)


@pytest.mark.parametrize("option", ["--speed=0", "--seconds=-3"])
def test_a_time_that_cannot_pass_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path, option: str
) -> None:
    ran = aquaflow("run", "--source", small_recording, option, "--out", tmp_path / "out")
    assert ran.code == MISUSED
    assert not (tmp_path / "out").exists()


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
    refused(ran, option, code=MISUSED)
    assert not (tmp_path / "out").exists()


def test_an_unknown_option_is_a_usage_error(aquaflow: Cli, tmp_path: Path) -> None:
    ran = aquaflow("map", tmp_path, "--evry", 2)
    assert ran.code == MISUSED
    assert "--evry" in ran.err
    assert "Traceback" not in ran.err


@pytest.mark.parametrize(
    ("option", "value"), [("scene", "moon"), ("water", "milk"), ("frames", 1), ("seed", -1)]
)
def test_a_synthetic_dive_that_does_not_exist_is_refused(
    aquaflow: Cli, tmp_path: Path, option: str, value: object
) -> None:
    refused(
        aquaflow("lab", "synth", tmp_path / "s", f"--{option}", value), f"--{option}", code=MISUSED
    )


def test_values_that_are_offered_can_be_given_as_they_are_offered(
    aquaflow: Cli, tmp_path: Path
) -> None:
    said = aquaflow("lab", "synth", tmp_path / "s", "--water", "milk")
    refused(said, "'coastal_1C'", "'oceanic_IB'", code=MISUSED)


@pytest.mark.parametrize(
    "words",
    [
        ("map", "R", "--preset", "moon"),
        ("map", "R", "--realtime", "--topic", "/a"),
        ("map", "R", "--realtime", "--view"),
        ("map", "R", "--telemetry-offset", "2"),
        ("map", "R", "--in", "D", "--out", "D"),
        ("run",),
        ("run", "--source", "R", "--preset", "moon"),
        ("run", "status", "--url", "ftp://here"),
        ("record",),
        ("record", "--source", "R", "--picture", "gif"),
        ("inspect", "R", "--fps", "0"),
        ("view", "D", "--port", "99999"),
        ("view", "D", "--white-balance", "purple"),
        ("export", "D", "--format", "laz", "--resolution", "1"),
        ("export", "D", "--format", "dem", "--resolution", "-1"),
        ("export", "D", "--format", "spz", "--out", "map.tif"),
        ("export", "D", "--format", "spz", "--white-balance", "daylight:tap"),
        ("export", "report", "D", "--pdf", "report.doc"),
        ("export", "video", "D", "--out", "x.mp4", "--seconds", "5"),
        ("measure", "D", "--point", "here"),
        ("measure", "D", "--cell", "0"),
        ("measure", "D", "--csv", "numbers.xls"),
        ("measure", "level", "D", "--point", "up"),
        ("change", "--from", "D", "--to", "D", "--false", "2"),
        ("calibrate", "--print-board", "board.doc"),
        ("calibrate", "--print-board", "board.pdf", "--columns", "1"),
        ("lab", "evaluate", "D", "--clean", "R", "--clean-crop", "middle"),
        ("lab", "stress", "--family", "moon"),
        ("lab", "ablate", "--suite", "ci", "--part", "moon"),
        ("lab", "bench", "--suite", "moon"),
        ("lab", "bench", "--suite", "ci", "--device", "abacus"),
        ("lab", "bench", "growth", "--frames", "1"),
        ("lab", "batch", "R", "--out", "SITE", "--retries", "-1"),
        ("lab", "prior", "train", "mast3r", "--checkpoint", "w", "--out", "o", "--data", "moon"),
    ],
    ids=" ".join,
)
def test_wrong_arguments_are_told_from_bad_files_by_their_exit_code(
    aquaflow: Cli,
    small_recording: Path,
    small_dive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    paths = {"R": small_recording, "D": small_dive}
    refused(aquaflow(*(paths.get(word, word) for word in words)), code=MISUSED)


def test_a_preset_says_which_settings_of_a_config_it_replaces(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("tracking: {matches: 900}\nsource: {stop: 3, width: 128}\n")
    given = ("map", small_recording, "--config", file, "--tracking-only", "--out", tmp_path / "out")
    ran = aquaflow(*given, "--preset", "fast")
    assert f"the preset 'fast' replaces settings of {file}: tracking.matches (2500 for 900)\n" in (
        ran.err
    )
    assert "replaces" not in aquaflow(*given, "--preset", "balanced", "--overwrite").err


# --- folders to write to and to read from ---------------------------------------------------------


def test_a_folder_with_other_files_is_not_written_to(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    for extra in ((), ("--overwrite",)):
        refused(aquaflow("map", small_recording, "--out", tmp_path, *extra), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_synthetic_dive_does_not_replace_other_pictures(aquaflow: Cli, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "holiday.png").write_bytes(b"irreplaceable")
    refused(aquaflow("lab", "synth", tmp_path, "--frames", 2), tmp_path)
    assert (tmp_path / "images" / "holiday.png").read_bytes() == b"irreplaceable"


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


def test_evaluate_needs_restored_views_or_something_to_compare_with(
    aquaflow: Cli, tmp_path: Path
) -> None:
    refused(aquaflow("lab", "evaluate", tmp_path), tmp_path, "--truth")


def test_evaluate_refuses_a_folder_that_is_no_dive(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    for folder in (tmp_path / "none", tmp_path):
        refused(aquaflow("lab", "evaluate", folder, "--truth", small_recording), folder)
        refused(aquaflow("lab", "evaluate", folder, "--clean", small_recording), folder)


@pytest.mark.parametrize(
    "words",
    [
        ("measure", "DIVE"),
        ("measure", "level", "DIVE", "--camera-pitch", "30"),
        ("measure", "scale", "DIVE", "--from", "1,2,3", "--to", "2,3,4", "--length", "1"),
        ("export", "DIVE", "--format", "laz"),
        ("export", "report", "DIVE"),
        ("export", "video", "DIVE", "--out", "x.mp4"),
        ("view", "DIVE"),
        ("run", "finish", "DIVE"),
        ("site", "add", "SITE", "DIVE"),
        ("change", "--from", "DIVE", "--to", "DIVE", "--transform", "t.json", "--out", "c"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_a_folder_that_is_not_there_or_is_no_dive_is_named_as_the_cause(
    aquaflow: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    none, empty = tmp_path / "none", tmp_path / "empty"
    empty.mkdir()
    for folder, said in ((none, "no folder"), (empty, "dive")):
        ran = aquaflow(*(str(folder) if each == "DIVE" else each for each in words))
        refused(ran, folder, said)
        assert "metric.json" not in ran.err


def test_evaluate_refuses_a_truth_that_is_none(
    aquaflow: Cli, small_dive: Path, tmp_path: Path
) -> None:
    truth = tmp_path / "truth.tum"
    refused(aquaflow("lab", "evaluate", small_dive, "--truth", truth), truth)
    truth.write_text("0.0 1 2 three 0 0 0 1\n")
    refused(aquaflow("lab", "evaluate", small_dive, "--truth", truth), truth)
