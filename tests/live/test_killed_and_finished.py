"""kill -9 in mid-dive: what is there can be read, and `aquaflow run finish` makes the rest."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import pytest

from aquaflow.base.storage.dive_status import DiveState, DiveStatus, read_status
from aquaflow.base.storage.whole_folder import FolderLock
from aquaflow.dive.frames_csv import read_rows
from aquaflow.dive.ply import read_ply
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.live.checkpoint.generations import read_state, state_file
from tests.command_line import Cli
from tests.live.killed_dives import CONFIG
from tests.live.paced import paced_run

KILLED_AT = 18
OFTEN = "{every_s: 0.01, deliverables_s: 0.01}"
HELD_OUT = "mapping:\n  hold_out_every: 3\n"


@pytest.fixture(scope="module")
def killed(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a dive whose process was killed once a report had been written."""
    folder = tmp_path_factory.mktemp("killed")
    config = CONFIG.replace("{every_s: 1.0}", OFTEN).replace("mapping:\n", HELD_OUT, 1)
    config = config.replace("source: {", "source: {width: 96, ")
    (folder / "vehicle.yaml").write_text(config)
    at = ("--killed-with-a-report-at", str(KILLED_AT))
    done = paced_run(small_recording, folder / "vehicle.yaml", folder / "dive", *at)
    assert done.returncode == -signal.SIGKILL, done.stderr
    return folder / "dive"


def test_a_killed_dive_has_a_map_a_trajectory_and_a_report(killed: Path) -> None:
    assert len(read_ply(killed / "map.ply").means) > 100
    assert len(read_ply(killed / "map_clear.ply").means) > 100
    path = read_tum(killed / "trajectory.tum")
    assert 3 <= len(path.positions) <= KILLED_AT
    report = (killed / "report.html").read_text()
    assert "written while the dive went on" in report
    assert report.rstrip().endswith("</html>")
    numbers = json.loads((killed / "metrics.json").read_text())
    assert numbers["complete"] is False
    assert numbers["tracked"] >= 3
    assert (killed / "calibration.yaml").is_file()
    assert list(killed.glob(".*.part")) == []


def test_a_killed_dive_says_that_it_is_open(killed: Path) -> None:
    status = read_status(killed)
    assert status is not None
    assert status.state is DiveState.OPEN


def test_a_dive_that_a_process_holds_is_not_finished_and_not_touched(
    aquaflow: Cli, killed: Path
) -> None:
    before = {path: path.stat().st_mtime_ns for path in killed.rglob("*")}
    lock = FolderLock(killed)
    ran = aquaflow("run", "finish", killed)
    lock.release()
    assert ran.code == 1
    assert "held by a running aquaflow" in ran.err
    assert {path: path.stat().st_mtime_ns for path in killed.rglob("*")} == before


def test_finishing_writes_every_file_and_marks_the_dive_and_is_done_once(
    aquaflow: Cli, killed: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    shutil.copytree(killed, dive)
    known = read_state(state_file(dive)).frames
    ran = aquaflow("run", "finish", dive, "--seconds", "0.5", "--json")
    assert ran.code in (0, 3), ran.err
    numbers = json.loads(ran.out)
    assert numbers["complete"] is True
    assert numbers["tracked"] >= len(known) - 2
    assert numbers["heldout_frames"] > 0
    assert numbers["psnr"] > 5.0
    assert {row.index for row in read_rows(dive / "frames.csv")} >= known
    status = read_status(dive)
    assert status is not None
    assert status.state is DiveState.FINISHED
    for name in ("checkpoint", "work"):
        assert not (dive / name).exists()
    for name in ("map.aqf", "map.ply", "trajectory.csv", "report.html", "medium.json"):
        assert (dive / name).is_file()
    assert "written while the dive went on" not in (dive / "report.html").read_text()
    before = {path: path.read_bytes() for path in dive.rglob("*") if path.is_file()}
    ran = aquaflow("run", "finish", dive)
    assert (ran.code, ran.out) == (0, f"{dive} is finished already.\n")
    assert {path: path.read_bytes() for path in dive.rglob("*") if path.is_file()} == before


def test_a_finished_dive_whose_process_had_no_time_to_tidy_is_tidied(
    aquaflow: Cli, tmp_path: Path
) -> None:
    for name in ("frames.csv", "metrics.json"):
        (tmp_path / name).write_text("{}")
    assert "finished already" in aquaflow("run", "finish", tmp_path).out  # a replay's
    DiveStatus(DiveState.FINISHED, False, None, "", None).write(tmp_path)
    (tmp_path / "checkpoint").mkdir()
    assert "finished already" in aquaflow("run", "finish", tmp_path).out
    assert not (tmp_path / "checkpoint").exists()


def test_what_is_no_dive_or_has_no_checkpoint_is_refused_in_a_sentence(
    aquaflow: Cli, killed: Path, tmp_path: Path
) -> None:
    ran = aquaflow("run", "finish", tmp_path)
    assert ran.code == 1
    assert "is no dive: it has no frames.csv" in ran.err
    dive = tmp_path / "dive"
    shutil.copytree(killed, dive)
    for file in (dive / "checkpoint").iterdir():
        file.write_bytes(b"damaged")
    ran = aquaflow("run", "finish", dive)
    assert ran.code == 1
    assert "has no checkpoint that can be read" in ran.err
