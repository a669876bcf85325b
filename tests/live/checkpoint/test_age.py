"""How old a dive is: clocks that ran on, that are behind, that nobody set."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import pytest

from aquaflow.base.storage.dive_status import DiveState
from aquaflow.base.storage.whole_folder import FolderLock
from aquaflow.config.service import CheckpointConfig
from aquaflow.live.checkpoint.resume import Choice, age_of, choose
from aquaflow.live.clock_reading import ClockReading
from tests.live.unfinished_dives import YESTERDAY, H, unfinished


def chosen(dives: Path, now: ClockReading, is_set: bool, resume_h: float = 12.0) -> Choice:
    config = CheckpointConfig(resume_h=resume_h)
    return choose(dives, config, False, now, lambda: is_set)


def after(hours: float, boot: str, wall_h: float) -> ClockReading:
    """The monotonic clock ``hours`` after YESTERDAY, or after another ``boot``; the wall clock."""
    monotonic_ns = round(hours * H)
    if boot == YESTERDAY.boot:
        monotonic_ns += YESTERDAY.monotonic_ns
    return ClockReading(monotonic_ns, YESTERDAY.wall_ns + round(wall_h * H), boot)


@pytest.mark.parametrize(
    ("now", "is_set", "hours"),
    [
        # The same boot: the wall clock may say what it likes.
        (after(2.0, YESTERDAY.boot, -50.0), False, 2.0),
        (after(2.0, YESTERDAY.boot, 50.0), True, 2.0),
        # Another boot, with a clock that was set.
        (after(0.1, "another", 2.0), True, 2.0),
        # Another boot: behind the files, set or not; and ahead of them, but nobody set it.
        (after(0.1, "another", -0.1), True, None),
        (after(0.1, "another", -20.0), False, None),
        (after(0.1, "another", 0.01), False, None),
    ],
)
def test_an_age_is_of_a_clock_that_ran_on_or_was_set(
    tmp_path: Path, now: ClockReading, is_set: bool, hours: float | None
) -> None:
    age = age_of(unfinished(tmp_path), YESTERDAY, now, lambda: is_set)
    assert age.hours == (None if hours is None else pytest.approx(hours))
    assert bool(age.unknown) == (hours is None)


def test_a_file_that_is_newer_than_the_checkpoint_shows_that_the_clock_is_behind(
    tmp_path: Path,
) -> None:
    dive, now = unfinished(tmp_path), after(0.1, "another", 1.0)
    rows = dive / "frames.csv"
    rows.touch()
    os.utime(rows, ns=(now.wall_ns + H, now.wall_ns + H))
    assert age_of(dive, YESTERDAY, now, lambda: True).hours is None


def test_no_boot_is_the_same_where_none_is_known() -> None:
    nowhere = replace(YESTERDAY, boot="")
    assert not nowhere.is_of_the_boot_of(replace(nowhere, monotonic_ns=nowhere.monotonic_ns + 1))


def test_yesterdays_dive_does_not_go_on_by_a_clock_that_is_behind(tmp_path: Path) -> None:
    old = unfinished(tmp_path)
    for wall_h, is_set in ((-10.0, False), (0.01, False), (-0.5, True)):
        choice = chosen(tmp_path, after(0.02, "another", wall_h), is_set)
        assert choice.checkpoint is None
        assert choice.folder != old
        assert choice.left == old
        (note,) = choice.notes
        assert "how old it is cannot be known" in note
        assert f"--out {old}" in note


def test_a_limit_of_zero_goes_on_whatever_the_age(tmp_path: Path) -> None:
    old = unfinished(tmp_path)
    assert chosen(tmp_path, after(0.02, "another", -10.0), False, resume_h=0.0).folder == old


def test_a_dive_of_this_boot_goes_before_one_whose_files_look_newer(tmp_path: Path) -> None:
    unfinished(tmp_path, "yesterday")
    taken = ClockReading(H, YESTERDAY.wall_ns - 5 * H, "today's boot")  # the clock was behind
    today = unfinished(tmp_path, "today", taken)
    now = replace(taken, monotonic_ns=taken.monotonic_ns + H)
    assert chosen(tmp_path, now, False).folder == today


def test_a_dive_that_was_being_finished_is_left_to_be_finished(tmp_path: Path) -> None:
    old = unfinished(tmp_path, state=DiveState.FINISHING)
    choice = chosen(tmp_path, after(0.1, YESTERDAY.boot, 0.1), True)
    assert (choice.checkpoint, choice.left) == (None, old)
    assert f"aquaflow run finish {old}" in choice.notes[0]


def test_a_finished_dive_that_was_not_tidied_is_not_gone_on_with(tmp_path: Path) -> None:
    unfinished(tmp_path, state=DiveState.FINISHED)
    choice = chosen(tmp_path, after(0.1, YESTERDAY.boot, 0.1), True)
    assert (choice.checkpoint, choice.left, choice.notes) == (None, None, ())


def test_a_dive_that_another_process_holds_is_not_gone_on_with(tmp_path: Path) -> None:
    old = unfinished(tmp_path)
    now = after(0.1, YESTERDAY.boot, 0.1)
    lock = FolderLock(old)
    assert chosen(tmp_path, now, True).checkpoint is None
    lock.release()
    assert chosen(tmp_path, now, True).folder == old


def test_now_is_of_this_boot_and_runs_on() -> None:
    first = ClockReading.now()
    assert first.boot
    assert first.is_of_the_boot_of(ClockReading.now())
    assert abs(first.wall_ns - time.time_ns()) < H
