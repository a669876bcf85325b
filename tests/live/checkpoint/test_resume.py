"""Which dive a start goes on with, and what becomes of those that cannot be gone on with."""

from __future__ import annotations

import os
import random
import time
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.storage.dive_status import DiveState, DiveStatus
from aquaflow.config.service import CheckpointConfig
from aquaflow.geometry.arrays import of_camera
from aquaflow.geometry.camera import guess_camera
from aquaflow.live.checkpoint.generations import (
    FORMAT,
    OtherFormatError,
    previous_file,
    read_state,
    state_file,
    write_state,
)
from aquaflow.live.checkpoint.resume import Choice, choose, resume_folder, tidy
from aquaflow.live.clock_reading import ClockReading
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.onboard import map_live
from aquaflow.tracking.frame_table import FRAME
from tests.live.live_scenes import VEHICLE, ToldFeed


def write_numbered(dive: Path, number: int) -> None:
    """A checkpoint of nothing, by whose clock it can be known again."""
    frames = {"tracking.frames": np.zeros(0, FRAME), "tracking.keyframes": np.zeros((0, 5))}
    camera = of_camera(guess_camera(64, 48))
    tracking = {"camera": camera, "source": {"width": None, "crop": None}}
    facts = {"format": FORMAT, "version": "0", "tracking": tracking, "clocks": {}}
    moment = ClockReading(number, time.time_ns(), "boot").to_json()
    write_state(dive, facts | {"moment": moment}, frames)


def numbers(dive: Path) -> list[int]:
    files = (state_file(dive), previous_file(dive))
    return [read_state(file).moment.monotonic_ns for file in files if file.is_file()]


@pytest.mark.parametrize("links", [True, False])
def test_the_last_two_checkpoints_are_kept(
    tmp_path: Path, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError("no links on this file system")

    if not links:
        monkeypatch.setattr(os, "link", refused)
    seen = []
    for number in range(4):
        write_numbered(tmp_path, number)
        seen.append(numbers(tmp_path))
    assert seen == [[0], [1, 0], [2, 1], [3, 2]]
    assert sorted(path.name for path in (tmp_path / "checkpoint").iterdir()) == [
        "previous.npz",
        "state.npz",
    ]


def test_after_a_kill_between_two_names_of_a_checkpoint_the_next_one_is_written(
    tmp_path: Path,
) -> None:
    write_numbered(tmp_path, 0)
    os.link(state_file(tmp_path), previous_file(tmp_path))
    os.link(state_file(tmp_path), tmp_path / "checkpoint" / "link.npz")
    write_numbered(tmp_path, 1)
    assert numbers(tmp_path) == [1, 0]


def test_no_flipped_bit_changes_what_a_checkpoint_says(tmp_path: Path) -> None:
    write_numbered(tmp_path, 7)
    file, rng = state_file(tmp_path), random.Random(0)
    whole, said = file.read_bytes(), read_state(file)
    for _ in range(300):
        data = bytearray(whole)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        file.write_bytes(data)
        try:
            again = read_state(file)
        except InputError:
            continue
        assert again.facts == said.facts
        assert list(again.arrays) == list(said.arrays)
        assert all(np.array_equal(again.arrays[name], said.arrays[name]) for name in said.arrays)


def test_a_checkpoint_of_another_version_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    write_state(tmp_path / "old", {"format": FORMAT - 1, "version": "0.0.9"}, {})
    with pytest.raises(OtherFormatError, match=r"version 0\.0\.9"):
        read_state(state_file(tmp_path / "old"))
    assert resume_folder(tmp_path / "old", new=False).folder == tmp_path / "old-2"


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 cut short", b"\x80\x04pickle"])
def test_a_damaged_checkpoint_is_left_alone_and_the_next_dive_is_beside(
    tmp_path: Path, damage: bytes
) -> None:
    file = state_file(tmp_path / "old")
    file.parent.mkdir(parents=True)
    file.write_bytes(damage)
    assert resume_folder(tmp_path / "old", new=False).folder == tmp_path / "old-2"
    choice = choose(tmp_path, CheckpointConfig(), new=False, now=ClockReading.now())
    assert choice.checkpoint is None
    assert choice.folder != tmp_path / "old"


@pytest.mark.parametrize("told", ["the recording ended", "stop requested"])
def test_only_a_dive_that_was_told_to_stop_can_be_resumed(tmp_path: Path, told: str) -> None:
    feed = ToldFeed()
    dive = LiveDive("dive", resume_folder(tmp_path / "dive", new=False), feed, VEHICLE)
    for name in ("work", "checkpoint"):
        (tmp_path / "dive" / name).mkdir()
    if told == "stop requested":
        dive.control.stopping.set()
    feed.newest.end()
    with dive:
        assert dive.run() is None  # not one frame: nothing was mapped
    assert dive.parts.loop.health.reason == told
    assert (tmp_path / "dive" / "checkpoint").exists() == (told == "stop requested")


def test_a_vehicle_whose_checkpoint_fits_nothing_begins_a_new_dive(tmp_path: Path) -> None:
    dives = tmp_path / "dives"
    (dives / "old").mkdir(parents=True)
    (dives / "old" / "frames.csv").write_text("index,source,t_s,class,sub_map,keyframe,quality,r\n")
    write_numbered(dives / "old", 0)
    whatever_its_age = CheckpointConfig(resume_h=0.0)
    service = VEHICLE.service.model_copy(update={"dives": dives, "checkpoint": whatever_its_age})
    feed = ToldFeed()
    feed.newest.end()
    assert map_live(feed, VEHICLE.model_copy(update={"service": service})) is None
    assert len(list(dives.iterdir())) == 2
    assert list((dives / "old").glob("set-aside-*/checkpoint/state.npz"))


def test_complete_dives_keep_no_files_for_a_resumption(tmp_path: Path) -> None:
    states = {"finished": DiveState.FINISHED, "stopped": DiveState.STOPPED}
    kept = {
        **dict.fromkeys(("current", "left", "damaged"), DiveState.STOPPED),
        "cut off": DiveState.OPEN, "in finishing": DiveState.FINISHING,
    }  # fmt: skip
    for name, state in (states | kept).items():
        (tmp_path / name / "work").mkdir(parents=True)
        (tmp_path / name / "checkpoint").mkdir()
        DiveStatus(state, False, None, "boot", None).write(tmp_path / name)
    state_file(tmp_path / "damaged").write_bytes(b"PK damaged")
    tidy(tmp_path, Choice(tmp_path / "current", left=tmp_path / "left"))
    for name in states:
        assert [path.name for path in (tmp_path / name).iterdir()] == ["dive.json"]
    for name in kept:
        assert (tmp_path / name / "checkpoint").is_dir()
