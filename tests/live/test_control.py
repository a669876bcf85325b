"""What a pilot may ask for in each phase of a dive, and what follows from it."""

from __future__ import annotations

import threading

import pytest

from aquaflow.live.control import DivePhase, RefusedError, ServiceControl, ServiceRequest

TABLE = {
    DivePhase.IDLE: {"start": "mapping", "new": "mapping"},
    DivePhase.MAPPING: {"stop": "paused", "finish": "finishing", "new": "finishing"},
    DivePhase.PAUSED: {"start": "mapping", "finish": "finishing", "new": "finishing"},
    DivePhase.FINISHING: {},
}
WAYS = {
    DivePhase.IDLE: [],
    DivePhase.MAPPING: [ServiceRequest.START],
    DivePhase.PAUSED: [ServiceRequest.START, ServiceRequest.STOP],
    DivePhase.FINISHING: [ServiceRequest.START, ServiceRequest.FINISH],
}
"""From the beginning to each phase."""


def at(phase: DivePhase) -> ServiceControl:
    control = ServiceControl()
    for request in WAYS[phase]:
        control.ask(request)
        control.begin()
    assert control.phase is phase
    return control


@pytest.mark.parametrize("request_", ServiceRequest)
@pytest.mark.parametrize("phase", DivePhase)
def test_every_request_in_every_phase(phase: DivePhase, request_: ServiceRequest) -> None:
    control, after = at(phase), TABLE[phase].get(request_.value)
    if after is None:
        with pytest.raises(RefusedError) as refused:
            control.ask(request_)
        assert len(str(refused.value).split()) > 3
        assert control.phase is phase
    else:
        assert control.ask(request_).value == after == control.phase.value


def test_a_dive_ends_when_it_is_finished_or_the_service_stops() -> None:
    assert not at(DivePhase.PAUSED).dive_ends
    assert at(DivePhase.FINISHING).dive_ends
    stopped = at(DivePhase.MAPPING)
    stopped.stopping.set()
    assert stopped.dive_ends
    with pytest.raises(RefusedError, match="the service is ending"):
        stopped.ask(ServiceRequest.STOP)


def test_after_a_finished_dive_the_service_is_idle_and_after_new_it_begins_another() -> None:
    control = at(DivePhase.MAPPING)
    control.ask(ServiceRequest.FINISH)
    control.end_dive()
    assert control.phase is DivePhase.IDLE
    control.ask(ServiceRequest.START)
    assert not control.begin()  # what can be gone on with is
    control.ask(ServiceRequest.NEW)
    control.end_dive()
    assert control.phase is DivePhase.MAPPING
    assert control.begin()
    control.ask(ServiceRequest.FINISH)
    control.end_dive()
    assert control.phase is DivePhase.IDLE


def test_a_new_dive_that_cannot_be_begun_is_not_tried_for_ever() -> None:
    control = ServiceControl()
    control.ask(ServiceRequest.NEW)
    assert control.begin()
    control.end_dive()
    assert control.phase is DivePhase.IDLE


def test_who_waits_is_woken_by_a_request() -> None:
    control, woken = ServiceControl(), threading.Event()

    def wait() -> None:
        control.wait(300.0)
        woken.set()

    threading.Thread(target=wait, daemon=True).start()
    control.ask(ServiceRequest.START)
    assert woken.wait(60.0)
