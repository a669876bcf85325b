"""A live dive in the frame of an earlier one, cut off and gone on with."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aquaflow.config.vehicle import looking_in
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.report import report
from aquaflow.sources import open_recording
from aquaflow.types import Frame
from tests.live.live_scenes import VEHICLE, ToldFeed, caught_up


@pytest.fixture(scope="module")
def base(small_dive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy that a test may move away."""
    return Path(shutil.copytree(small_dive, tmp_path_factory.mktemp("base") / "yesterday"))


@pytest.fixture(scope="module")
def cut(
    small_recording: Path, base: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[LiveDive]:
    """A dive of the same place, up to its checkpoint, as a process that was killed leaves it."""
    folder = tmp_path_factory.mktemp("dives") / "cut"
    frames = open_recording(small_recording).frames(stop=16)
    dive = LiveDive("cut", resume_folder(folder, new=False), ToldFeed(), looking_in(VEHICLE, base))
    for frame in frames:
        assert isinstance(frame, Frame)
        dive.parts.loop.take(frame)
        dive.parts.slam.take_finished(wait=True)
    caught_up(dive)
    dive.parts.checkpointer.take()
    caught_up(dive)
    dive.folder._lock.release()
    yield dive
    dive.close()


def test_the_pilot_is_told_that_the_place_was_found(cut: LiveDive) -> None:
    said = report(cut.parts, hang_s=1e6)["in_site"]
    assert said["site"] == "yesterday"
    assert said["state"] == "found", (said, len(cut.parts.slam.keyframes))
    assert said["links"] >= 2


def test_a_dive_that_goes_on_is_in_the_site_without_being_asked_again(cut: LiveDive) -> None:
    with LiveDive("cut", resume_folder(cut.folder.path, new=False), ToldFeed(), VEHICLE) as back:
        old, new = cut.parts.slam, back.parts.slam
        assert old.in_base is not None
        assert new.in_base is not None
        assert [link.keyframe for link in new.in_base.links] == [
            link.keyframe for link in old.in_base.links
        ]
        assert new.in_base.first == old.in_base.first
        mine, theirs = new.metric_frame(0), old.metric_frame(0)
        assert mine.site == "yesterday"
        assert np.allclose(mine.T_nm.matrix, theirs.T_nm.matrix, atol=1e-3)
        assert new.in_base._places._places != []
        assert new.maps.taken_over == old.maps.taken_over > 0


def test_a_dive_keeps_its_place_in_a_site_that_is_gone(cut: LiveDive, base: Path) -> None:
    away = base.rename(base.with_name("away"))
    try:
        with LiveDive(
            "cut", resume_folder(cut.folder.path, new=False), ToldFeed(), VEHICLE
        ) as back:
            assert back.parts.slam.metric_frame(0).site == "yesterday"
            notes = " ".join(back.parts.run.notes)
            assert "keeps its place there" in notes
    finally:
        away.rename(base)


def test_a_site_that_cannot_be_read_costs_itself_and_not_the_dive(tmp_path: Path) -> None:
    vehicle = looking_in(VEHICLE, tmp_path / "nowhere")
    with LiveDive("new", resume_folder(tmp_path / "dive", new=True), ToldFeed(), vehicle) as dive:
        assert dive.parts.slam.in_base is None
        assert any("is no folder" in note for note in dive.parts.run.notes)
