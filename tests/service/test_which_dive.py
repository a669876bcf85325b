"""Which dive a start goes on with, and what becomes of those that cannot be gone on with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from live_scenes import VEHICLE, ToldFeed

from aquaflow.config.service import CheckpointConfig
from aquaflow.errors import InputError
from aquaflow.frame_table import FRAME
from aquaflow.service.checkpoint import FORMAT, state_file, write_state
from aquaflow.service.choice import choose, resumed, tidy
from aquaflow.service.moment import Moment
from aquaflow.service.onboard import map_live
from aquaflow.service.session import LiveDive


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 cut short", b"\x80\x04pickle"])
def test_a_damaged_checkpoint_is_refused_and_the_next_dive_is_new(
    tmp_path: Path, damage: bytes
) -> None:
    file = state_file(tmp_path / "old")
    file.parent.mkdir(parents=True)
    file.write_bytes(damage)
    with pytest.raises(InputError, match="--new"):
        resumed(tmp_path / "old", new=False)
    choice = choose(tmp_path, CheckpointConfig(), new=False, now=Moment.now())
    assert choice.checkpoint is None
    assert choice.folder != tmp_path / "old"


@pytest.mark.parametrize("told", ["the recording ended", "told to stop"])
def test_only_a_dive_that_was_told_to_stop_can_be_resumed(tmp_path: Path, told: str) -> None:
    feed = ToldFeed()
    dive = LiveDive("dive", resumed(tmp_path / "dive", new=False), feed, VEHICLE)
    for name in ("work", "checkpoint"):
        (tmp_path / "dive" / name).mkdir()
    if told == "told to stop":
        dive.parts.loop.stopping.set()
    feed.newest.end()
    with dive:
        assert dive.run() is None  # not one frame: nothing was mapped
    assert dive.parts.loop.health.reason == told
    assert (tmp_path / "dive" / "checkpoint").exists() == (told == "told to stop")


def test_a_vehicle_whose_checkpoint_fits_nothing_begins_a_new_dive(tmp_path: Path) -> None:
    dives = tmp_path / "dives"
    (dives / "old").mkdir(parents=True)
    (dives / "old" / "frames.csv").write_text("index,source,t_s,class,sub_map,keyframe,quality,r\n")
    frames = {"tracking.frames": np.zeros(0, FRAME)}
    facts = {
        "format": FORMAT,
        "version": "0",
        "moment": Moment.now().to_json(),
        "tracking": {},
        "clocks": {},
    }
    write_state(dives / "old", facts, frames)
    service = VEHICLE.service.model_copy(update={"dives": dives})
    feed = ToldFeed()
    feed.newest.end()
    assert map_live(feed, VEHICLE.model_copy(update={"service": service})) is None
    assert len(list(dives.iterdir())) == 2
    assert state_file(dives / "old").is_file()


def test_finished_dives_keep_no_files_for_a_resumption(tmp_path: Path) -> None:
    for name in ("old", "current"):
        (tmp_path / name / "work").mkdir(parents=True)
        (tmp_path / name / "checkpoint").mkdir()
        (tmp_path / name / "report.html").touch()
    tidy(tmp_path, tmp_path / "current")
    assert sorted(path.name for path in (tmp_path / "old").iterdir()) == ["report.html"]
    assert (tmp_path / "current" / "checkpoint").is_dir()
