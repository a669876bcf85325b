"""A disk that takes no more, in a process of its own: the operating system says no, not a mock."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.dive.frames_csv import read_rows
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.live.checkpoint.generations import read_state, state_file
from tests.command_line import Cli
from tests.live.killed_dives import CONFIG
from tests.live.paced import paced_run
from tests.small_recording import FRAMES

FPS = 10.0
FULL_WITH_A_MAP_AT = 18
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


@pytest.mark.slow
def test_deliverables_of_an_earlier_moment_are_set_aside_and_the_dive_is_finished_with_room_again(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    dive, config = tmp_path / "dive", tmp_path / "vehicle.yaml"
    config.write_text(CONFIG.replace("{every_s: 1.0}", "{every_s: 0.01, deliverables_s: 0.01}"))
    at = ("--little-room-with-a-report-at", str(FULL_WITH_A_MAP_AT))
    done = paced_run(small_recording, config, dive, *at)
    assert done.returncode == 1
    assert f"make room and run `aquaflow run finish {dive}`" in done.stderr
    last_s = read_tum(dive / "trajectory.tum").t_s[-1]
    assert last_s == pytest.approx((FRAMES - 1) / FPS)  # it is of the end
    for name in ("map.ply", "map_clear.ply", "report.html"):
        assert not (dive / name).exists()
    earlier = (dive / "report.earlier.html").read_text()
    assert "written while the dive went on" in earlier
    assert (dive / "map.earlier.ply").is_file()
    ran = aquaflow("export", dive, "--format", "spz")
    assert (ran.code, ran.out) == (1, "")
    assert f"the disk was full; `aquaflow run finish {dive}` does the rest" in ran.err
    ran = aquaflow("run", "finish", dive)
    assert ran.code in (0, 3), ran.err
    assert list(dive.rglob("*.earlier.*")) == []
    for name in ("map.aqf", "map.ply", "report.html", "metrics.json"):
        assert (dive / name).is_file()
    assert aquaflow("export", dive, "--format", "spz").code == 0
