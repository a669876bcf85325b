"""A disk that takes no more, in a process of its own: the operating system says no, not a mock."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest
from killed_dives import CONFIG

from aquaflow.frame_rows import read_rows
from aquaflow.service.checkpoint import read_state, state_file

ROOM_BYTES = 64
"""No file can become larger: nothing new can be written, what is there stays."""
GIVE_UP_S = 120.0


def start(source: Path, folder: Path) -> subprocess.Popen[str]:
    command = [str(Path(sys.executable).with_name("aquaflow")), "run", "--speed", "0.3"]
    command += ["--config", str(folder / "vehicle.yaml"), "--source", str(source)]
    command += ["--out", str(folder / "dive")]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("full")
    (folder / "vehicle.yaml").write_text(CONFIG.replace("every_s: 1.0", "every_s: 0.3"))
    return folder


@pytest.fixture(scope="module")
def full(small_recording: Path, folder: Path) -> tuple[int, str]:
    """Exit status and last words of a dive whose disk is full after the first checkpoint."""
    process, deadline = start(small_recording, folder), time.monotonic() + GIVE_UP_S
    while not state_file(folder / "dive").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline, "no checkpoint was written"
        time.sleep(0.01)
    room = (ROOM_BYTES, resource.RLIM_INFINITY)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, room)
    _, said = process.communicate(timeout=GIVE_UP_S)
    return process.returncode, said


def logged(folder: Path) -> str:
    return (folder / "dive" / "log.jsonl").read_text()


def test_the_user_hears_of_a_full_disk_in_one_sentence(full: tuple[int, str]) -> None:
    status, said = full
    assert status == 1
    assert "cannot write" in said
    assert "Traceback" not in said


def test_what_was_written_before_stays_whole(full: tuple[int, str], folder: Path) -> None:
    known = read_state(folder / "dive").frames
    written = {row.index for row in read_rows(folder / "dive" / "frames.csv")}
    assert known
    assert known <= written


def test_with_room_again_the_dive_is_taken_up_and_finished(
    full: tuple[int, str], small_recording: Path, folder: Path
) -> None:
    process = start(small_recording, folder)
    _, said = process.communicate(timeout=GIVE_UP_S)
    assert process.returncode == 0, said
    assert "resumed" in logged(folder)
    metrics = json.loads((folder / "dive" / "metrics.json").read_text())
    assert metrics["tracked"] > 10
    assert (folder / "dive" / "map.ply").stat().st_size > 1000
