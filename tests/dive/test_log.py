"""log.jsonl: when, about whom, what; bounded whatever repeats."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest

from aquaflow.dive.log import EVERY_S, KINDS, MOST_EARLY, WHOLE, EarlyRecords, JsonLog, Repeats

log = logging.getLogger("aquaflow.test")


def entries(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.jsonl"


def test_an_entry_says_when_about_which_device_and_what(path: Path) -> None:
    written = JsonLog(path, dive_s=lambda: 12.34567)
    written.attach()
    fields = {"event": "lost", "source": "front"}
    log.warning("camera '%s' is lost", "front", extra={"fields": fields})
    written.close()
    (entry,) = entries(path)
    assert entry.pop("utc").endswith("Z")
    assert entry == {
        "t_s": 12.346, "level": "warning", "logger": "aquaflow.test", "event": "lost",
        "message": "camera 'front' is lost", "source": "front",
    }  # fmt: skip


def test_what_was_logged_before_the_dive_is_taken_by_it_once(path: Path) -> None:
    was_told = log.isEnabledFor(logging.INFO)
    EarlyRecords().attach()
    EarlyRecords().attach()
    for number in range(MOST_EARLY + 1):
        log.info("%s early", "x" * (number % 7))
    written = JsonLog(path)
    written.attach()
    log.info("late")
    written.close()
    messages = [entry["message"] for entry in entries(path)]
    assert messages[:3] == ["x early", "xx early", "xxx early"]  # the very first had no room
    assert messages[7 * WHOLE] == "late"
    assert {entry["t_s"] for entry in entries(path)} == {None}
    assert log.isEnabledFor(logging.INFO) == was_told


def test_a_device_that_comes_and_goes_for_an_hour_takes_some_lines(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    written = JsonLog(path)
    written.attach()
    for second in range(3600):
        now[0] = float(second)
        log.warning("dvl: no byte for %d s", second)
        log.info("dvl: reconnected")
    written.close()
    about = [entry for entry in entries(path) if "no byte" in entry["message"]]
    assert len(about) <= WHOLE + 3600 / EVERY_S + 1
    assert len(about) + sum(entry.get("left_out", 0) for entry in about) == 3600
    assert about[-1]["message"] == "dvl: no byte for 3599 s"
    assert len(entries(path)) == 2 * len(about)


def test_what_differs_in_more_than_its_numbers_is_written_whole() -> None:
    repeats = Repeats(lambda: 0.0)
    for _ in range(WHOLE):
        assert repeats.admit({"n": 1}, "the disk is full") == {"n": 1}
    assert repeats.admit({"n": 2}, "the disk is full") is None
    assert repeats.admit({"n": 3}, "the disk is slow") == {"n": 3}
    assert repeats.held_entries() == [{"n": 2}]
    assert repeats.held_entries() == []


def test_kinds_that_were_not_met_for_long_are_forgotten() -> None:
    repeats = Repeats(lambda: 0.0)
    for number in range(3 * KINDS):
        repeats.admit({}, "abcdefghijklmnopqrstuvwxyz"[number % 26] * (number // 26 + 1))
    assert len(repeats._met) == KINDS


def test_another_thread_may_log_while_the_dive_ends(path: Path) -> None:
    written = JsonLog(path)
    written.close()
    written.handle(logging.LogRecord("aquaflow", logging.INFO, "", 0, "too late", (), None))
    assert entries(path) == []
