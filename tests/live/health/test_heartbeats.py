"""Heartbeats: what the watchdog and systemd receive, and what they do not."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from aquaflow.live.health.heartbeats import Heartbeats, Notifier, Watchdog
from tests.live.live_scenes import Clock, Told


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """What systemd listens on."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        yield listening


def heard(manager: socket.socket) -> list[str]:
    messages = []
    while True:
        try:
            messages.append(manager.recv(4096).decode())
        except BlockingIOError:
            return messages


def notifier(manager: socket.socket, **more: str) -> Notifier:
    return Notifier({"NOTIFY_SOCKET": manager.getsockname(), **more})


def test_without_a_manager_nothing_is_said() -> None:
    silent = Notifier({})
    silent.ready()
    silent.alive()
    silent.close()


def test_ready_is_said_once_and_a_status_when_it_changes(manager: socket.socket) -> None:
    notify = notifier(manager)
    for _ in range(2):
        notify.ready()
        notify.status("tracking: all is well")
    notify.stopping()
    assert heard(manager) == ["READY=1", "STATUS=tracking: all is well", "STOPPING=1"]


def test_the_watchdog_is_fed_twice_as_often_as_it_asks(manager: socket.socket) -> None:
    notify = notifier(manager, WATCHDOG_USEC="2000000")
    for tenth in range(31):
        notify.alive(100.0 + tenth / 10)
    assert len(heard(manager)) == 4


def test_a_watchdog_of_another_process_is_not_fed(manager: socket.socket) -> None:
    notifier(manager, WATCHDOG_USEC="2000000", WATCHDOG_PID="1").alive(100.0)
    assert heard(manager) == []


def test_the_silent_stage_is_found_and_a_retired_one_is_not() -> None:
    clock = Clock()
    heartbeats = Heartbeats(clock)
    heartbeats.beat("tracking")
    heartbeats.beat("mapping")
    clock.pass_(50.0)
    heartbeats.beat("tracking")
    assert heartbeats.find_hung_stage(60.0) is None
    clock.pass_(20.0)
    assert heartbeats.find_hung_stage(60.0) == "mapping"
    heartbeats.retire("mapping")
    assert heartbeats.find_hung_stage(60.0) is None


def test_the_watchdog_ends_the_process_of_a_hung_stage() -> None:
    clock, ended = Clock(), threading.Event()
    heartbeats, told = Heartbeats(clock), []

    def end(stage: str, silent_s: float) -> None:
        told.append((stage, silent_s))
        ended.set()

    heartbeats.beat("mapping")
    clock.pass_(61.0)
    watchdog = Watchdog(heartbeats, 60.0, end, look_s=0.01)
    assert ended.wait(20.0)
    watchdog.close()
    assert told == [("mapping", 61.0)]


def test_the_loop_feeds_the_watchdog_only_while_mapping_lives(
    tmp_path: Path, manager: socket.socket
) -> None:
    told = Told(tmp_path / "dive")
    told.vitals.notifier = notifier(manager, WATCHDOG_USEC="1000")
    told.idle(1.0)
    assert "WATCHDOG=1" in heard(manager)
    told.close()  # the mapping thread has ended, so that nobody beats for it
    told.heartbeats._last_s["mapping"] = told.heartbeats._now_s() - 2 * told.config.hang_s
    told.idle(1.0)
    assert "WATCHDOG=1" not in heard(manager)
