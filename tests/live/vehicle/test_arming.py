"""Dives that an autopilot's arming begins and ends, and commands of a ground station."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.config.service import DiveConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live.control import DivePhase, RefusedError, ServiceControl, ServiceRequest
from aquaflow.live.onboard import map_live
from aquaflow.live.service_status import ServiceStatus
from aquaflow.live.vehicle.arming import Arming, refuse_without_autopilot
from aquaflow.sources.outbound import Obey
from tests.live.live_scenes import ToldFeed


class LastingFeed(ToldFeed):
    """Of cameras, not of a recording."""

    lasting = True


BOTH = DiveConfig(begin="when_armed", finish="when_disarmed", disarmed_s=10.0, commands=True)
SERVICE = cast(ServiceStatus, SimpleNamespace())


class Autopilot:
    """Says what the test says."""

    def __init__(self) -> None:
        self.armed: bool | None = None
        self.asked: Obey | None = None

    def obey(self, asked: Obey) -> None:
        self.asked = asked


class Vehicle:
    """A service, without dives, whose turns come once a second."""

    def __init__(self, config: DiveConfig = BOTH) -> None:
        self.control, self.autopilot, self.now_s = ServiceControl(), Autopilot(), 0.0
        self.arming = Arming(config, self.control, self.autopilot)

    def seconds(self, count: int, armed: bool | None) -> list[DivePhase]:
        """The phases after each turn."""
        self.autopilot.armed = armed
        phases = []
        for _ in range(count):
            self.now_s += 1.0
            self.arming.update(SERVICE, self.now_s)
            phases.append(self.control.phase)
        return phases


def test_arming_begins_a_dive_and_disarming_finishes_it_after_a_while() -> None:
    vehicle = Vehicle()
    assert set(vehicle.seconds(3, None) + vehicle.seconds(3, armed=False)) == {DivePhase.IDLE}
    assert set(vehicle.seconds(5, armed=True)) == {DivePhase.MAPPING}
    assert set(vehicle.seconds(10, armed=False)) == {DivePhase.MAPPING}
    assert set(vehicle.seconds(3, armed=False)) == {DivePhase.FINISHING}
    vehicle.control.end_dive()
    assert set(vehicle.seconds(30, armed=False)) == {DivePhase.IDLE}


def test_a_short_disarming_belongs_to_the_dive() -> None:
    vehicle = Vehicle()
    vehicle.seconds(5, armed=True)
    for _ in range(3):
        vehicle.seconds(9, armed=False)
        assert set(vehicle.seconds(9, armed=True)) == {DivePhase.MAPPING}


def test_a_dive_that_the_pilot_finished_is_not_begun_anew_before_the_next_arming() -> None:
    vehicle = Vehicle()
    vehicle.seconds(2, armed=True)
    vehicle.control.ask(ServiceRequest.FINISH)
    vehicle.control.end_dive()
    assert set(vehicle.seconds(5, armed=True) + vehicle.seconds(1, armed=False)) == {DivePhase.IDLE}
    assert set(vehicle.seconds(2, armed=True)) == {DivePhase.MAPPING}


def test_who_is_armed_while_a_dive_is_being_finished_gets_the_next_one() -> None:
    vehicle = Vehicle()
    vehicle.seconds(2, armed=True)
    vehicle.seconds(12, armed=False)
    assert set(vehicle.seconds(3, armed=True)) == {DivePhase.FINISHING}
    vehicle.control.end_dive()
    assert set(vehicle.seconds(3, armed=True)) == {DivePhase.MAPPING}


def test_a_dive_begun_before_the_arming_is_not_finished_until_that_ended() -> None:
    vehicle = Vehicle()
    vehicle.control.ask(ServiceRequest.START)
    assert set(vehicle.seconds(30, armed=False)) == {DivePhase.MAPPING}
    vehicle.seconds(1, armed=True)
    assert vehicle.seconds(20, armed=False)[-1] is DivePhase.FINISHING


def test_a_dive_begun_after_the_disarming_is_not_finished_by_it() -> None:
    vehicle = Vehicle()
    vehicle.seconds(2, armed=True)
    vehicle.control.ask(ServiceRequest.FINISH)
    vehicle.control.end_dive()
    vehicle.seconds(3, armed=False)
    vehicle.control.ask(ServiceRequest.START)
    assert set(vehicle.seconds(30, armed=False)) == {DivePhase.MAPPING}


def test_a_service_that_is_ending_takes_no_orders_of_the_arming() -> None:
    vehicle = Vehicle()
    vehicle.control.stopping.set()
    assert set(vehicle.seconds(3, armed=True)) == {DivePhase.IDLE}


def test_by_default_arming_means_nothing_and_commands_are_not_heard() -> None:
    vehicle = Vehicle(DiveConfig())
    assert set(vehicle.seconds(5, armed=True)) == {DivePhase.IDLE}
    vehicle.control.ask(ServiceRequest.START)
    assert set(vehicle.seconds(100, armed=False)) == {DivePhase.MAPPING}
    assert vehicle.autopilot.asked is None


def test_commands_are_obeyed_where_they_make_sense() -> None:
    vehicle = Vehicle()
    ask = vehicle.autopilot.asked
    assert ask is not None
    assert [ask("finish"), ask("start"), ask("start"), ask("stop")] == [False, True, False, True]
    assert vehicle.control.phase is DivePhase.PAUSED


# --- the config -----------------------------------------------------------------------------------


def config(dive: dict[str, Any], talk: bool | None) -> VehicleConfig:
    device = {"kind": "mavlink", "talk": talk, "link": {"kind": "udp", "port": 14550}}
    devices = {} if talk is None else {"autopilot": device}
    return VehicleConfig.model_validate(
        {"service": {"dive": dive}, "telemetry": {"devices": devices}}
    )


@pytest.mark.parametrize(
    "dive", [{"begin": "when_armed"}, {"finish": "when_disarmed"}, {"commands": True}]
)
def test_what_needs_an_autopilot_is_refused_without_one(dive: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=rf"service\.dive\.{next(iter(dive))}.*kind mavlink"):
        refuse_without_autopilot(config(dive, talk=None))
    refuse_without_autopilot(config(dive, talk=True))


def test_commands_need_a_link_that_may_answer() -> None:
    with pytest.raises(ConfigError, match="talk: true"):
        refuse_without_autopilot(config({"commands": True}, talk=False))
    refuse_without_autopilot(config({"begin": "when_armed"}, talk=False))


def test_a_service_without_the_autopilot_that_it_waits_for_does_not_start(tmp_path: Path) -> None:
    with contextlib.suppress(RefusedError), pytest.raises(ConfigError, match="when_armed"):
        map_live(LastingFeed(), config({"begin": "when_armed"}, talk=None))
