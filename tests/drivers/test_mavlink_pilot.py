"""Arming and commands as an ArduSub and a ground station send them, over a real socket."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from aquaflow.config.telemetry import parse_telemetry
from aquaflow.drivers.protocol.mavlink import (
    ACCEPTED,
    FIRST_COMMAND,
    OUR_COMPONENT,
    REFUSED_NOW,
    UNSUPPORTED,
)
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.wires import TcpWire
from tests.small_recording import GIVE_UP_S

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

MAV_CMD_REQUEST_MESSAGE = 512
GIMBAL = 154


class Link:
    """An ArduSub at the other end."""

    def __init__(self, talk: bool) -> None:
        self.autopilot, wire = ArduSub(), TcpWire()
        self._simulated = SimulatedDevice(self.autopilot, wire, []).start()
        link = {"kind": "tcp", "host": "127.0.0.1", "port": wire.port}
        device = {"kind": "mavlink", "talk": talk, "link": link}
        self.telemetry = LinkTelemetry(parse_telemetry({"devices": {"sub": device}}, "test"))
        self.asked: list[str] = []

    def obey(self, request: str) -> bool:
        self.asked.append(request)
        return request != "stop"

    def until(self, true: Callable[[], bool]) -> None:
        deadline = time.monotonic() + GIVE_UP_S
        while not true():
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def close(self) -> None:
        self.telemetry.close()
        self._simulated.close()


@pytest.fixture
def link() -> Iterator[Link]:
    link = Link(talk=True)
    yield link
    link.close()


def test_arming_is_heard_and_unknown_before(link: Link) -> None:
    link.until(lambda: link.telemetry.armed is False)
    link.autopilot.armed = True
    link.until(lambda: link.telemetry.armed is True)
    link.autopilot.armed = False
    link.until(lambda: link.telemetry.armed is False)


def test_each_command_is_obeyed_and_acknowledged(link: Link) -> None:
    link.telemetry.obey(link.obey)
    link.until(lambda: link.telemetry.armed is not None)
    for number in range(4):
        link.autopilot.command(FIRST_COMMAND + number, OUR_COMPONENT)
    link.autopilot.command(MAV_CMD_REQUEST_MESSAGE, OUR_COMPONENT)
    link.until(lambda: len(link.autopilot.acknowledged) == 5)
    assert link.asked == ["start", "stop", "finish", "new"]
    results = [ACCEPTED, REFUSED_NOW, ACCEPTED, ACCEPTED, UNSUPPORTED]
    numbers = [*range(FIRST_COMMAND, FIRST_COMMAND + 4), MAV_CMD_REQUEST_MESSAGE]
    assert link.autopilot.acknowledged == list(zip(numbers, results, strict=True))


def test_a_repeated_command_is_acknowledged_and_not_obeyed_again(link: Link) -> None:
    link.telemetry.obey(link.obey)
    link.until(lambda: link.telemetry.armed is not None)
    for confirmation in (0, 1, 2, 0):
        link.autopilot.command(FIRST_COMMAND, OUR_COMPONENT, confirmation)
    link.until(lambda: len(link.autopilot.acknowledged) == 4)
    assert link.autopilot.acknowledged == [(FIRST_COMMAND, ACCEPTED)] * 4
    assert link.asked == ["start", "start"]


def test_commands_to_others_are_theirs(link: Link) -> None:
    link.telemetry.obey(link.obey)
    link.until(lambda: link.telemetry.armed is not None)
    link.autopilot.command(FIRST_COMMAND, GIMBAL)
    link.autopilot.command(FIRST_COMMAND + 1, OUR_COMPONENT)
    link.until(lambda: bool(link.autopilot.acknowledged))
    assert link.asked == ["stop"]
    assert link.autopilot.acknowledged == [(FIRST_COMMAND + 1, REFUSED_NOW)]


@pytest.mark.parametrize("talk", [True, False])
def test_nothing_is_answered_unasked_or_by_who_only_listens(talk: bool) -> None:
    link = Link(talk)
    try:
        if not talk:
            link.telemetry.obey(link.obey)
        link.until(lambda: link.telemetry.armed is not None)
        link.autopilot.command(FIRST_COMMAND, OUR_COMPONENT)
        link.autopilot.armed = True  # by a heartbeat that comes after the command
        link.until(lambda: link.telemetry.armed is True)
        assert link.asked == []
        assert link.autopilot.acknowledged == []
    finally:
        link.close()
