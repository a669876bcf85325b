"""A recorder whose time passes when the test says so."""

from __future__ import annotations

import time

import pytest

from aquaflow.live.recorder import Recorder, writing
from aquaflow.live.recorder import recorder as recorder_module
from tests.small_recording import GIVE_UP_S


class SimulatedTime:
    """What the recorder's modules know as ``time``; it passes when a test says so."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()


def simulated(monkeypatch: pytest.MonkeyPatch) -> SimulatedTime:
    """Give it to the recorder."""
    clock = SimulatedTime()
    monkeypatch.setattr(recorder_module, "time", clock)
    monkeypatch.setattr(writing, "time", clock)
    return clock


def written(recorder: Recorder, frames: int) -> None:
    """Wait until the recorder's thread has written so many."""
    deadline = time.monotonic() + GIVE_UP_S
    while recorder.status.frames < frames:
        assert time.monotonic() < deadline, "pictures were not written"
        time.sleep(0.0005)
