"""Views of a dive: found by their entry points, and shown by a thread that nothing ends."""

from __future__ import annotations

import logging
import threading

import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.dive import views
from aquaflow.dive.views import DisplayThread, open_coverage
from aquaflow.survey.coverage.live_coverage import LiveCoverage


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
        showing = DisplayThread("map", show, pause_s=0.01)
        assert again.wait(30.0)
        showing.close()
    assert "the dive could not be shown: map" in caplog.text
    assert "map" not in {thread.name for thread in threading.enumerate()}


def test_coverage_is_found_by_its_entry_point() -> None:
    found = open_coverage(Failures())
    try:
        assert isinstance(found, LiveCoverage)
        assert found.sentences() == ()
    finally:
        found.close()


def test_a_view_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(views, "entry_points", lambda **asked: [])
    with pytest.raises(InputError, match="no view 'coverage' is installed; reinstall aquaflow"):
        open_coverage(Failures())
