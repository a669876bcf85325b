"""A disk that takes no more, in a process of its own: the operating system says no, not a mock."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.dive.frames_csv import read_rows
from aquaflow.live.checkpoint.generations import read_state, state_file
from tests.live.killed_dives import CONFIG
from tests.live.paced import paced_run
from tests.small_recording import FRAMES

FULL_AT = 12
"""The picture at which the disk is full, once there is a checkpoint of those before it."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("full")
    (folder / "vehicle.yaml").write_text(CONFIG.replace("every_s: 1.0", "every_s: 0.01"))
    return folder


@pytest.fixture(scope="module")
def full(small_recording: Path, folder: Path) -> tuple[int, str]:
    """Exit status and last words of a dive whose disk is full after a checkpoint."""
    at = ("--full-disk-at", str(FULL_AT))
    done = paced_run(small_recording, folder / "vehicle.yaml", folder / "dive", *at)
    return done.returncode, done.stderr


def logged(folder: Path) -> str:
    return (folder / "dive" / "log.jsonl").read_text()


def test_the_user_hears_of_a_full_disk_in_one_sentence(full: tuple[int, str]) -> None:
    status, said = full
    assert status == 1
    assert "the disk is full" in said
    assert "Traceback" not in said


def test_what_was_written_before_stays_whole(full: tuple[int, str], folder: Path) -> None:
    known = read_state(state_file(folder / "dive")).frames
    written = {row.index for row in read_rows(folder / "dive" / "frames.csv")}
    assert known
    assert known <= written


def test_with_room_again_the_dive_is_taken_up_and_finished(
    full: tuple[int, str], small_recording: Path, folder: Path
) -> None:
    known = len(read_state(state_file(folder / "dive")).frames)
    done = paced_run(small_recording, folder / "vehicle.yaml", folder / "dive")
    assert done.returncode == 0, done.stderr
    assert "resumed" in logged(folder)
    metrics = json.loads((folder / "dive" / "metrics.json").read_text())
    assert metrics["tracked"] >= known + FRAMES - FULL_AT
    posed = [
        row.index for row in read_rows(folder / "dive" / "frames.csv") if row.keyframe is not None
    ]
    assert posed[-1] == FRAMES - 1
    assert (folder / "dive" / "map.ply").stat().st_size > 1000
