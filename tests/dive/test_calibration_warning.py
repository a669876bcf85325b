"""A calibration that does not fit is said first: by the command, in the report, in metrics.json."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.config import Config
from aquaflow.dive import replay, run
from aquaflow.geometry.camera import load_camera, save_camera
from aquaflow.keyframes import Keyframe
from aquaflow.sources import open_recording
from aquaflow.tracking.calibration_check import MIN_VIEWS
from tests.command_line import Cli

TRACKING = Config.model_validate({"threads": 1, "mapping": {"enabled": False}})


def test_a_wrong_focal_length_is_said_first_and_ends_with_3(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    wrong, dive = tmp_path / "wrong", tmp_path / "dive"
    shutil.copytree(small_recording, wrong)
    save_camera(load_camera(wrong / "camera.yaml").with_focal_scaled(0.75), wrong / "camera.yaml")

    ran = aquaflow("map", wrong, "--out", dive, "--tracking-only")

    assert ran.code == 3, ran.err
    assert ran.out.startswith("Warning: the calibration does not fit the dive")
    numbers = json.loads((dive / "metrics.json").read_text())
    [warning] = numbers["warnings"]
    assert warning in ran.out
    assert numbers["calibration_check"]["verdict"] == "wrong"
    assert numbers["calibration_check"]["focal_px"] == pytest.approx(136.0, abs=20.0)
    assert numbers["calibration_check"]["focal_given_px"] == 102.0
    assert "the calibration does not fit the dive" in (dive / "report.html").read_text()


def test_a_given_calibration_that_cannot_be_checked_is_noted_and_no_other_is(
    small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "lens_error", lambda keyframes: None)
    recording = open_recording(small_recording)
    assert recording.camera is not None
    beside = f"the calibration is {small_recording / 'camera.yaml'}"
    assert beside in recording.notes
    finished = replay.map_recording(
        recording, "unchecked", tmp_path / "dive", TRACKING, recording.camera.with_focal_scaled(1.0)
    )
    assert finished.metrics["calibration_check"] is None
    said = "whether the calibration fits could not be checked"
    assert sum(note.startswith(said) for note in finished.notes) == 1
    assert beside not in finished.notes
    assert "the calibration is the one that was given (--calib)" in finished.notes


@pytest.mark.parametrize("how", [(), ("--realtime",)])
def test_a_calibration_that_a_short_dive_cannot_judge_is_noted_and_named(
    aquaflow: Cli, small_recording: Path, tmp_path: Path, how: tuple[str, ...]
) -> None:
    recording = open_recording(small_recording)
    assert recording.camera is not None
    save_camera(recording.camera.with_focal_scaled(1.1), tmp_path / "longer.yaml")
    ran = aquaflow(
        *("map", small_recording, "--calib", tmp_path / "longer.yaml", "--tracking-only", *how),
        *("--stop", 12, "--out", tmp_path / "dive"),
    )
    assert "camera.yaml" not in ran.out
    if not how:  # what the live loop takes of a recording depends on the machine
        assert "Note: whether the calibration fits could not be checked" in ran.out
        assert "Note: the calibration is the one that was given (--calib)." in ran.out


def test_twice_the_focal_length_is_told_by_a_second_with_hardly_a_keyframe(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    recording = open_recording(small_recording)
    assert recording.camera is not None
    save_camera(recording.camera.with_focal_scaled(2.0), tmp_path / "twice.yaml")
    ran = aquaflow(
        *("map", small_recording, "--calib", tmp_path / "twice.yaml", "--tracking-only"),
        *("--stop", 12, "--out", tmp_path / "dive"),
    )
    assert ran.code == 3, ran.err
    assert ran.out.startswith("Warning: the calibration does not fit the dive")
    numbers = json.loads((tmp_path / "dive" / "metrics.json").read_text())
    assert numbers["keyframes"] < MIN_VIEWS
    assert numbers["calibration_check"]["verdict"] == "wrong"
    assert numbers["calibration_check"]["focal_px"] == pytest.approx(136.0, abs=30.0)


def test_the_right_calibration_is_no_warning(small_dive: Path) -> None:
    numbers = json.loads((small_dive / "metrics.json").read_text())
    assert numbers["warnings"] == []
    assert numbers["calibration_check"]["verdict"] != "wrong"
    assert numbers["calibration_check"]["chance"] > 0.001


@pytest.mark.usefixtures("contained")
def test_a_check_that_fails_costs_itself(
    small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(keyframes: Sequence[Keyframe]) -> Any:
        raise np.linalg.LinAlgError("planted")

    monkeypatch.setattr(run, "lens_error", fail)
    finished = replay.map_recording(
        open_recording(small_recording), "contained", tmp_path / "dive", TRACKING
    )
    assert [each["stage"] for each in finished.metrics["failures"]] == ["calibration check"]
    assert finished.metrics["calibration_check"] is None
    assert (finished.dive / "report.html").exists()
