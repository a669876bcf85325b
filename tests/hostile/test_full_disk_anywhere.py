"""A disk without room, in a process of its own: one sentence, and no file cut in the middle."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
import yaml

from tests.small_recording import HASTY


def run_with_room(room_bytes: int, *arguments: object) -> subprocess.CompletedProcess[str]:
    """``aquaflow`` where no file can become longer than ``room_bytes``; a compiled module neither,
    which Python would cut short without a word and later refuse to load."""
    return subprocess.run(
        [str(Path(sys.executable).with_name("aquaflow")), *map(str, arguments)],
        env=dict(os.environ) | {"PYTHONDONTWRITEBYTECODE": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, room_bytes)),
        capture_output=True,
        text=True,
        check=False,
    )


def half_written(folder: Path) -> list[str]:
    """Files that are there but cannot be read to their end."""
    found = [str(path) for path in folder.rglob("*.part")]
    for path in folder.rglob("*"):
        try:
            if path.suffix == ".png" and cv2.imread(str(path)) is None:
                found.append(str(path))
            elif path.suffix == ".json":
                json.loads(path.read_text())
            elif path.suffix == ".yaml":
                assert isinstance(yaml.safe_load(path.read_text()), dict)
        except (ValueError, AssertionError, yaml.YAMLError):
            found.append(str(path))
    return found


@pytest.mark.parametrize("room_bytes", [64, pytest.param(40_000, marks=pytest.mark.slow)])
def test_mapping_onto_a_full_disk_is_told_in_one_sentence(
    small_recording: Path, tmp_path: Path, room_bytes: int
) -> None:
    dive = tmp_path / "dive"
    done = run_with_room(room_bytes, "map", small_recording, "--out", dive, *HASTY)
    assert done.returncode == 1, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("aquaflow: ")
    assert str(dive) in line
    assert half_written(dive) == []


@pytest.mark.slow
def test_a_benchmark_onto_a_full_disk_is_told_in_one_sentence(
    small_recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "bench"
    done = run_with_room(
        64,
        "lab",
        "bench",
        "--scene",
        small_recording,
        "--preset",
        "fast",
        "--no-peers",
        "--out",
        out,
    )
    assert done.returncode == 1, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("aquaflow: cannot ")
    assert half_written(out) == []
