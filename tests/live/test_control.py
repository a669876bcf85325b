"""What a pilot may ask for in each phase of a dive, and what follows from it."""

from __future__ import annotations

import threading

import pytest

from aquaflow.live.control import Control, Phase, RefusedError, Request

TABLE = {
    Phase.IDLE: {"start": "mapping", "new": "mapping"},
    Phase.MAPPING: {"stop": "paused", "finish": "finishing", "new": "finishing"},
    Phase.PAUSED: {"start": "mapping", "finish": "finishing", "new": "finishing"},
    Phase.FINISHING: {},
}
WAYS = {
    Phase.IDLE: [],
    Phase.MAPPING: [Request.START],
    Phase.PAUSED: [Request.START, Request.STOP],
    Phase.FINISHING: [Request.START, Request.FINISH],
}
"""From the beginning to each phase."""


def at(phase: Phase) -> Control:
    control = Control()
    for request in WAYS[phase]:
        control.ask(request)
        control.begin()
    assert control.phase is phase
    return control


@pytest.mark.parametrize("request_", Request)
@pytest.mark.parametrize("phase", Phase)
def test_every_request_in_every_phase(phase: Phase, request_: Request) -> None:
    control, after = at(phase), TABLE[phase].get(request_.value)
    if after is None:
        with pytest.raises(RefusedError) as refused:
            control.ask(request_)
        assert len(str(refused.value).split()) > 3
        assert control.phase is phase
    else:
        assert control.ask(request_).value == after == control.phase.value


def test_a_dive_ends_when_it_is_finished_or_the_service_stops() -> None:
    assert not at(Phase.PAUSED).dive_ends
    assert at(Phase.FINISHING).dive_ends
    stopped = at(Phase.MAPPING)
    stopped.stopping.set()
    assert stopped.dive_ends
    with pytest.raises(RefusedError, match="the service is ending"):
        stopped.ask(Request.STOP)


def test_after_a_finished_dive_the_service_is_idle_and_after_new_it_begins_another() -> None:
    control = at(Phase.MAPPING)
    control.ask(Request.FINISH)
    control.ended()
    assert control.phase is Phase.IDLE
    control.ask(Request.START)
    assert not control.begin()  # what can be gone on with is
    control.ask(Request.NEW)
    control.ended()
    assert control.phase is Phase.MAPPING
    assert control.begin()
    control.ask(Request.FINISH)
    control.ended()
    assert control.phase is Phase.IDLE


def test_a_new_dive_that_cannot_be_begun_is_not_tried_for_ever() -> None:
    control = Control()
    control.ask(Request.NEW)
    assert control.begin()
    control.ended()
    assert control.phase is Phase.IDLE


def test_who_waits_is_woken_by_a_request() -> None:
    control, woken = Control(), threading.Event()

    def wait() -> None:
        control.wait(300.0)
        woken.set()

    threading.Thread(target=wait, daemon=True).start()
    control.ask(Request.START)
    assert woken.wait(60.0)
