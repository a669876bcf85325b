"""A dive that is cut off and goes on: what the checkpoint holds, and what becomes of it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from urllib.request import urlopen

import numpy as np
import pytest
import torch

from aquaflow.base.storage import spill
from aquaflow.config.service import CheckpointConfig, ViewerConfig
from aquaflow.dive.frames_csv import read_rows
from aquaflow.dive.ply import read_ply
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.live.checkpoint.generations import read_state, state_file
from aquaflow.live.checkpoint.resume import choose, is_begun, resume_folder
from aquaflow.live.clock_reading import ClockReading, Continued
from aquaflow.live.health.http import exposition
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.report import report
from aquaflow.sources import open_recording
from aquaflow.survey.viewer.live_viewer import LiveViewer, in_words
from aquaflow.tracking.graph.keyframe_graph import LOOP_SEARCH
from aquaflow.types import Frame
from tests.live.live_scenes import VEHICLE, ToldFeed, caught_up

CLOCKS = {"autopilot": [[12, 12_000_000_000, 345, None, None]]}
CUT = 12
"""Frames before the cut."""


@dataclass
class Cut:
    """A dive up to its checkpoint; nobody closed it."""

    folder: Path
    dive: LiveDive
    frames: list[Frame]
    rows: int


@pytest.fixture(scope="module")
def cut(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cut]:
    recording, folder = open_recording(small_recording), tmp_path_factory.mktemp("dives") / "cut"
    frames = [frame for frame in recording.frames(stop=20) if isinstance(frame, Frame)]
    dive = LiveDive("cut", resume_folder(folder, new=False), ToldFeed(), VEHICLE)
    for frame in frames[:CUT]:
        dive.parts.loop.take(frame)
    caught_up(dive)
    dive.feed.learned = CLOCKS  # type: ignore[attr-defined]
    dive.parts.checkpointer.take()
    caught_up(dive)
    rows = len(read_rows(folder / "frames.csv"))
    dive.parts.loop.take(frames[CUT])  # after the checkpoint: lost
    dive.folder._lock.release()  # as the kernel does for a process that was killed
    yield Cut(folder, dive, frames, rows)
    dive.close()


@pytest.fixture(scope="module")
def back(cut: Cut) -> Iterator[LiveDive]:
    dive = LiveDive("cut", resume_folder(cut.folder, new=False), ToldFeed(), VEHICLE)
    dive.folder._lock.release()  # further tests look at the folder as nobody's
    yield dive
    dive.close()


def test_the_map_comes_back_bit_for_bit(cut: Cut, back: LiveDive) -> None:
    old, new = cut.dive.parts.maps.mappers[0], back.parts.maps.mappers[0]
    saved = read_state(state_file(cut.folder)).arrays
    assert len(new.gaussians) > 100
    assert len(new.gaussians.local_features) == len(new.gaussians)  # or pruning would fail
    for name, tensor in new.gaussians.parameters.items():
        assert np.array_equal(tensor.numpy(), saved[f"mapping.map0.gaussians.{name}"]), name
    assert len(new.views) == len(saved["mapping.map0.views.numbers"])
    for mine, theirs in zip(new.views, old.views, strict=False):
        assert np.array_equal(mine.image, theirs.image)
        assert mine.frame_index == theirs.frame_index
    assert new.medium.active == old.medium.active


def test_the_optimisers_and_the_random_state_come_back(cut: Cut, back: LiveDive) -> None:
    new, saved = back.parts.maps.mappers[0], read_state(state_file(cut.folder)).arrays
    for kind, moments in (
        ("first", new.optimiser.adam.first_moments),
        ("second", new.optimiser.adam.second_moments),
    ):
        for name, tensor in moments.items():
            assert np.array_equal(tensor.numpy(), saved[f"mapping.map0.adam.{kind}.{name}"])
        assert any(bool(tensor.any()) for tensor in moments.values())
    assert torch.equal(new._random.get_state(), torch.from_numpy(saved["mapping.map0.random"]))


def test_what_fails_after_a_restart_is_counted_with_the_dives_failures(back: LiveDive) -> None:
    failures = back.parts.slam.failures
    mapper = back.parts.maps.mappers[0]
    assert mapper.failures is mapper.water_fitting.failures is failures


def test_idle_moments_give_the_frames_of_the_past_their_poses(cut: Cut) -> None:
    rows = read_rows(cut.folder / "frames.csv")
    started = [row.index for row in rows].index(0)
    order = [row.index for row in rows[started:]]
    newest = order[1]  # frame 0 is the keyframe, and this one started the map with it
    past = [index for index in order[1:] if index < newest]
    assert past == list(range(newest - 1, 0, -1))
    assert order.index(newest + 1) < order.index(past[0])
    assert all(row.keyframe is not None for row in rows[started:CUT])


def test_keyframes_poses_and_graph_come_back(cut: Cut, back: LiveDive) -> None:
    old, new = cut.dive.parts.slam, back.parts.slam
    count = len(new.keyframes)
    assert count >= 2
    for mine, theirs in zip(new.keyframes.keyframes, old.keyframes.keyframes, strict=False):
        assert np.array_equal(mine.T_wc.t, theirs.T_wc.t)
        assert np.array_equal(mine.encoding.grey, theirs.encoding.grey)  # type: ignore[attr-defined]
    assert sum(t.T_wc is not None for t in back.parts.run.results) == cut.rows
    tables = new.graph.graph.tables()
    assert len(tables["nodes"]) == count
    assert len(tables["edges"]) >= count - 1


def test_what_was_decided_after_the_checkpoint_is_told_to_be_lost(cut: Cut, back: LiveDive) -> None:
    lost = [row for row in read_rows(cut.folder / "frames.csv") if row.frame_class == "dropped"]
    assert [row.reason for row in lost] == ["lost in a restart"]
    assert back.feed.continued.first_index == lost[0].index + 1  # type: ignore[attr-defined]


def test_the_dive_goes_on_at_its_old_place_and_ends_as_one(cut: Cut, back: LiveDive) -> None:
    for frame in cut.frames[CUT + 1 :]:
        back.parts.loop.take(frame)
    caught_up(back)
    states = [change.after.value for change in back.parts.loop.health.changes]
    assert states[0] in {"lost", "tracking"}
    assert states[-1] == "tracking"
    finished = back.parts.run.finish([])
    assert finished.metrics["tracked"] >= len(cut.frames) - 3
    sub_maps = {t.sub_map for t in back.parts.run.results if t.T_wc is not None}
    assert sub_maps == {0}
    assert (cut.folder / "map.ply").is_file()


def test_the_newest_unfinished_dive_is_chosen_unless_it_is_old_or_new_is_asked_for(
    cut: Cut,
) -> None:
    dives, config, now = cut.folder.parent, CheckpointConfig(), ClockReading.now()
    assert choose(dives, config, False, now).folder == cut.folder
    assert choose(dives, config, True, now).folder != cut.folder
    later = replace(now, monotonic_ns=now.monotonic_ns + round(13 * 3.6e12))
    assert choose(dives, config, False, later).folder != cut.folder
    assert choose(dives, CheckpointConfig(resume_h=0.0), False, later).folder == cut.folder


def test_a_dive_that_was_cut_off_before_its_first_checkpoint_may_begin_anew(
    cut: Cut, tmp_path: Path
) -> None:
    assert not is_begun(cut.folder)
    (tmp_path / "frames.csv").touch()
    assert is_begun(tmp_path)
    (tmp_path / "metrics.json").touch()
    assert not is_begun(tmp_path)


def test_a_full_disk_writes_no_checkpoint(cut: Cut) -> None:
    checkpointer, taken = cut.dive.parts.checkpointer, cut.dive.parts.checkpointer.taken
    checkpointer._due_s = 0.0
    checkpointer.take_if_due(disk_is_full=True)
    caught_up(cut.dive)
    assert checkpointer.taken == taken


def test_no_checkpoint_names_files_that_the_disk_did_not_take(
    cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpointer, before = cut.dive.parts.checkpointer, state_file(cut.folder).read_bytes()
    taken, failures = checkpointer.taken, checkpointer.failures
    monkeypatch.setattr(spill, "RESERVE_BYTES", 1 << 60)
    checkpointer.take()
    caught_up(cut.dive)
    assert (checkpointer.taken, checkpointer.failures) == (taken, failures + 1)
    assert state_file(cut.folder).read_bytes() == before
    monkeypatch.undo()
    checkpointer.take()  # there is room again
    caught_up(cut.dive)
    assert checkpointer.taken == taken + 1
    files = list((cut.folder / "work" / "keyframes").glob("*.arrays"))
    assert len(files) == len(cut.dive.parts.slam.keyframes)


def test_the_deliverables_of_a_dive_that_goes_on_are_those_of_one_moment(cut: Cut) -> None:
    parts = cut.dive.parts
    parts.refresher.write_soon()
    parts.refresher.write_if_due(disk_is_full=False)
    while parts.refresher.written == 0:
        caught_up(cut.dive)
    posed = {t.frame.t_ns: t.T_wc for t in parts.run.results if t.T_wc is not None}
    path = read_tum(cut.folder / "trajectory.tum")
    assert path.t_s == pytest.approx([t_ns * 1e-9 for t_ns in sorted(posed)])
    for T_wc, position, wxyz in zip(
        [posed[t_ns] for t_ns in sorted(posed)], path.positions, path.wxyz, strict=True
    ):
        np.testing.assert_allclose(position, T_wc.t, atol=2e-9)
        np.testing.assert_allclose(wxyz, T_wc.quaternion, atol=2e-9)
    gaussians = sum(len(mapper.gaussians) for mapper in parts.maps.mappers.values())
    assert len(read_ply(cut.folder / "map.ply").means) == gaussians
    numbers = json.loads((cut.folder / "metrics.json").read_text())
    assert (numbers["complete"], numbers["tracked"]) == (False, len(posed))
    assert numbers["gaussians"] == gaussians
    told = report(parts, hang_s=1e6)["deliverables"]
    assert told["written"] == 1
    assert told["cpu_s"] > 0.0


@pytest.mark.parametrize(
    ("boot", "later_ns", "wall_ns", "shift_ns"),
    [
        ("a", 5_000, 10**15, 0),  # the wall clock jumps, the process alone was restarted
        ("b", -900, 60 * 10**9, 60 * 10**9 + 900),  # another boot, a minute later
        ("b", -900, -(10**15), 10**9 + 900),  # another boot, and the wall clock was set back
    ],
)
def test_the_dives_clock_goes_on_over_restarts_and_jumps(
    boot: str, later_ns: int, wall_ns: int, shift_ns: int
) -> None:
    before = ClockReading(1_000_000, 10**18, "a")
    now = ClockReading(1_000_000 + later_ns, 10**18 + wall_ns, boot)
    assert before.shift_ns(now) == shift_ns


def test_the_dives_clock_goes_on_over_two_boots_and_a_restart() -> None:
    first = ClockReading(5_000, 10**18, "a")
    second = ClockReading(100, 10**18 + 2 * 10**9, "b")
    second = replace(second, dive_shift_ns=first.shift_ns(second))
    assert second.dive_ns == 5_000 + 2 * 10**9
    restarted = ClockReading(700, 10**18 + 3 * 10**9, "b")
    assert second.shift_ns(restarted) == second.dive_shift_ns
    third = ClockReading(50, second.wall_ns + 4 * 10**9, "c")
    assert third.monotonic_ns + second.shift_ns(third) == second.dive_ns + 4 * 10**9


def test_a_devices_clock_is_known_after_a_restart_but_not_after_another_boot(
    cut: Cut, back: LiveDive
) -> None:
    assert back.feed.continued.clocks == CLOCKS  # type: ignore[attr-defined]
    before, rebooted = ClockReading(1_000_000, 10**18, "a"), ClockReading(900, 10**18, "b")
    assert Continued.after(before, [], CLOCKS, rebooted).clocks == {}


# --- whoever looks on -----------------------------------------------------------------------------


def test_the_report_of_a_real_dive_is_json_and_prometheus(cut: Cut) -> None:
    told = report(cut.dive.parts, hang_s=1e6)
    assert json.loads(json.dumps(told))["keyframes"] == len(cut.dive.parts.slam.keyframes)
    assert told["gaussians"] > 100
    assert f"aquaflow_gaussians {told['gaussians']}" in exposition(told)


def test_the_live_window_shows_map_path_and_health(cut: Cut) -> None:
    parts = cut.dive.parts
    config = ViewerConfig(port=0, splats=300)
    window = LiveViewer(config, lambda: report(parts, hang_s=1e6))
    try:
        urlopen(f"{window.address}scene.json").close()  # a browser looks on
        window.update(parts.loop)
        deadline = time.monotonic() + 60.0
        while window.splats_shown == 0:
            assert time.monotonic() < deadline, "no splats were shown"
            time.sleep(0.05)
        assert window.splats_shown <= 300
    finally:
        window.close()
    assert "lag" in in_words(report(parts, hang_s=1e6))


def test_a_checkpoint_waits_for_a_search_of_loops_and_a_frame_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken, go_on = list[bool](), Event()
    with LiveDive("new", resume_folder(tmp_path / "new", new=False), ToldFeed(), VEHICLE) as dive:
        worker, checkpointer = dive.parts.slam.worker, dive.parts.checkpointer
        worker.ask(LOOP_SEARCH, 0, lambda: go_on.wait(60.0))
        checkpointer.take_soon()
        with monkeypatch.context() as told:
            told.setattr(checkpointer, "take", lambda: taken.append(True))
            checkpointer.take_if_due(disk_is_full=False)
        assert taken == []
        go_on.set()
        checkpointer.take()
        assert not worker.waiting(LOOP_SEARCH)
