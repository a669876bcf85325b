"""The thread that shows a dive to those who look on."""

from __future__ import annotations

import logging
import threading

import pytest

from aquaflow.live.showing import Showing


def test_what_fails_is_logged_and_shown_again_until_it_is_closed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    calls, again = list[int](), threading.Event()

    def show() -> None:
        calls.append(len(calls))
        if len(calls) == 1:
            raise OSError("gone")
        again.set()

    with caplog.at_level(logging.ERROR):
        showing = Showing("map", show, pause_s=0.01)
        assert again.wait(30.0)
        showing.close()
    assert "the dive could not be shown: map" in caplog.text
    assert "map" not in {thread.name for thread in threading.enumerate()}
