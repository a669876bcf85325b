"""Several devices on one UDP port: each hears its own datagrams, whoever sends them."""

from __future__ import annotations

import logging
import random
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.drivers.link import LinkLostError
from aquaflow.drivers.shared_ports import PortDivision
from aquaflow.drivers.telemetry import LinkTelemetry, decoder_of
from aquaflow.drivers.transport.ports import MOST_WAITING, SharedUdp
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.nmea_talker import NmeaTalker, sentence
from aquaflow.sim_drivers.devices.pd0 import Pd0Dvl
from aquaflow.sim_drivers.devices.waterlinked import line
from aquaflow.sim_drivers.devices.wires import UdpWire
from aquaflow.types import Altitude, Attitude, Velocity
from tests.drivers.simulated_links import free_port, motion, until

DIALECT: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
WAIT_S = 10.0


def config(port: int, **devices: dict[str, Any]) -> dict[str, Any]:
    """Devices that listen on one port; ``sender`` goes into the link."""
    return {
        "devices": {
            name: {
                **{key: value for key, value in device.items() if key != "sender"},
                "link": {"kind": "udp", "host": "127.0.0.1", "port": port}
                | ({"sender": device["sender"]} if "sender" in device else {}),
            }
            for name, device in devices.items()
        }
    }


AUTOPILOT: dict[str, Any] = {"kind": "mavlink", "talk": False}
SONAR: dict[str, Any] = {
    "kind": "mavlink",
    "component_id": 194,
    "messages": ["DISTANCE_SENSOR"],
    "external_pressure": None,
    "talk": False,
}
COMPASS: dict[str, Any] = {"kind": "nmea0183", "assume": {"level": True}}


def packet(message: str, system: int, component: int, *fields: float) -> bytes:
    wire = DIALECT.MAVLink(None, srcSystem=system, srcComponent=component)
    return bytes(getattr(DIALECT, f"MAVLink_{message}_message")(*fields).pack(wire))


def attitude(system: int = 1) -> bytes:
    return packet("attitude", system, 1, 1000, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)


def distance(cm: int, component: int = 194) -> bytes:
    return packet("distance_sensor", 1, component, 1000, 20, 5000, cm, 1, 0, 25, 255)


@contextmanager
def division(**devices: dict[str, Any]) -> Iterator[PortDivision]:
    parsed = parse_telemetry(config(14550, **devices), "test").devices
    decoders = {name: decoder_of(name, device) for name, device in parsed.items()}
    yield PortDivision(14550, parsed, decoders)


def test_four_simulated_devices_on_one_port_are_heard_as_if_each_had_its_own():
    port = free_port()
    devices = {"autopilot": AUTOPILOT, "dvl": {"kind": "pd0"}, "compass": COMPASS, "sonar": SONAR}
    telemetry = LinkTelemetry(parse_telemetry(config(port, **devices), "test"))
    protocols: list[Any] = [ArduSub(), Pd0Dvl(), NmeaTalker()]
    # UDP loses what finds no room: the kernel's buffer has some 250 datagrams of all four together,
    # and a busy machine may not read for a second.
    talkers = [
        SimulatedDevice(each, UdpWire(("127.0.0.1", port)), motion(), 1.0) for each in protocols
    ]
    ping = UdpWire(("127.0.0.1", port))
    until(lambda: all(link.is_open for link in telemetry.links.values()))

    for talker in talkers:
        talker.start()
    counted = telemetry.counters()
    for k in range(919):
        ping.send(distance(100 + k))
        until(lambda k=k: counted["sonar"].samples > k - 10)
    until(lambda: all(talker.finished.is_set() for talker in talkers))
    until(lambda: counted["autopilot"].messages >= talkers[0].sent)
    until(lambda: counted["dvl"].messages >= 20 and counted["sonar"].samples == 919)
    until(lambda: counted["compass"].messages >= talkers[2].sent)
    telemetry.close()
    heard = list(telemetry.samples())
    for talker in talkers:
        talker.close()

    ranges = [s.altitude_m for s in heard if s.source == "sonar/DISTANCE_SENSOR"]
    assert ranges == pytest.approx([(100 + k) / 100 for k in range(919)])
    assert len([s for s in heard if s.source.startswith("dvl/") and isinstance(s, Velocity)]) == 20
    assert {type(s) for s in heard if s.source.startswith("compass/")} >= {Attitude, Altitude}
    for counters in counted.values():
        assert (counters.garbage_bytes, counters.bad_checksums, counters.unheard) == (0, 0, 0)


def test_packets_of_one_datagram_go_to_the_devices_that_use_their_senders():
    draw, mixed = random.Random(4), []
    expected: dict[str, bytes] = {"autopilot": b"", "sonar": b""}
    for k in range(2000):
        owner = draw.choice(["autopilot", "sonar"])
        data = attitude() if owner == "autopilot" else distance(100 + k)
        mixed.append(data)
        expected[owner] += data
    with division(autopilot=AUTOPILOT, sonar=SONAR) as ports:
        found = {"autopilot": b"", "sonar": b""}
        while mixed:
            count = draw.randint(1, 5)
            datagram, mixed = b"".join(mixed[:count]), mixed[count:]
            for name, part in ports.divide(datagram, ("192.168.2.2", 14550)).items():
                found[name] += part
    assert found == expected


def test_what_no_mavlink_device_uses_goes_to_the_first_with_all_damage():
    stray, damaged = distance(100, component=7), attitude()[:-3] + b"xyz"
    with division(autopilot=AUTOPILOT, sonar=SONAR) as ports:
        parts = ports.divide(b"??" + distance(300) + stray + damaged, ("192.168.2.2", 14550))
    assert parts == {"sonar": distance(300), "autopilot": b"??" + stray + damaged}


def test_two_vehicles_of_the_same_ids_are_told_apart_by_their_address():
    with division(
        one={**AUTOPILOT, "sender": "10.0.0.1"},
        two={**AUTOPILOT, "sender": "10.0.0.2:5"},
        other=AUTOPILOT,
    ) as ports:
        named = [
            [*ports.divide(attitude(), sender)]
            for sender in [("10.0.0.1", 9), ("10.0.0.2", 5), ("10.0.0.2", 6), ("10.0.0.3", 5)]
        ]
    assert named == [["one"], ["two"], ["other"], ["other"]]


def test_half_a_sentence_follows_the_whole_ones_of_its_sender(caplog):
    heading = sentence("HEHDT,123.4,T")
    dvl = line("wrx,112.83,0.007,0.017,0.006,0.1,0.93,y,0")
    with division(compass=COMPASS, dvl={"kind": "waterlinked_serial"}) as ports:
        assert [*ports.divide(heading, ("10.0.0.1", 1))] == ["compass"]
        assert [*ports.divide(dvl, ("10.0.0.2", 1))] == ["dvl"]
        assert ports.divide(heading[:7], ("10.0.0.1", 1)) == {"compass": heading[:7]}
        assert ports.divide(dvl[7:], ("10.0.0.2", 1)) == {"dvl": dvl[7:]}
    assert caplog.records == []


def test_what_is_nobodys_is_counted_and_its_sender_named_once(caplog):
    parsed = parse_telemetry(
        config(10110, dvl={"kind": "pd0", "sender": "10.0.0.5"}, compass={**COMPASS}), "test"
    ).devices
    decoders = {name: decoder_of(name, device) for name, device in parsed.items()}
    alone = {"dvl": parsed["dvl"]}
    with caplog.at_level(logging.WARNING):
        ports = PortDivision(10110, alone, decoders)
        assert [ports.divide(b"anything", ("10.0.0.9", k)) for k in range(3)] == [{}] * 3
    [record] = caplog.records
    assert "UDP port 10110: what comes from 10.0.0.9 is of no device" in record.getMessage()
    assert decoders["dvl"].counters.unheard == 3


def test_many_senders_are_forgotten_and_none_is_mixed_up():
    with division(autopilot=AUTOPILOT, compass=COMPASS) as ports:
        for k in range(500):
            assert [*ports.divide(attitude(), ("10.0.0.1", k))] == ["autopilot"]
            assert [*ports.divide(sentence("HEHDT,1.0,T"), ("10.0.0.2", k))] == ["compass"]
        assert ports.divide(b"half", ("10.0.0.1", 499)) == {"autopilot": b"half"}
        assert ports.divide(b"half", ("10.0.0.1", 3)) == {}


def everything(data: bytes, sender: Any) -> dict[str, bytes]:
    return {"a": data, "b": data}


def test_a_device_answers_its_own_sender_and_the_port_is_free_after_the_last():
    port = free_port()
    shared = SharedUdp("127.0.0.1", port, lambda data, sender: {data[:1].decode(): data})
    a, b = shared.open("a"), shared.open("b")
    one, other = UdpWire(("127.0.0.1", port)), UdpWire(("127.0.0.1", port))
    a.write(b"nobody is there yet")

    one.send(b"a1")
    other.send(b"b1")
    assert (a.read(WAIT_S), b.read(WAIT_S), a.read(0.0)) == (b"a1", b"b1", b"")
    a.write(b"to one")
    b.write(b"to other")
    until(lambda: one.receive() == b"to one")
    until(lambda: other.receive() == b"to other")
    a.close()
    with pytest.raises(LinkLostError, match="closed"):
        a.read(WAIT_S)
    other.send(b"b2")
    assert b.read(WAIT_S) == b"b2"
    b.close()
    b.close()
    with pytest.raises(LinkLostError):
        b.write(b"too late")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", port))
        with pytest.raises(LinkLostError, match=f"cannot use UDP 127.0.0.1:{port}"):
            shared.open("a")
    again = shared.open("a")
    one.send(b"a2")
    assert again.read(WAIT_S) == b"a2"
    again.close()


def test_a_driver_that_fails_costs_the_links_and_not_the_port(caplog):
    def divide(data: bytes, sender: Any) -> dict[str, bytes]:
        if data == b"bad":
            raise KeyError("a mistake")
        return everything(data, sender)

    port = free_port()
    shared = SharedUdp("127.0.0.1", port, divide)
    a, b = shared.open("a"), shared.open("b")
    talker = UdpWire(("127.0.0.1", port))

    talker.send(b"bad")
    for link in (a, b):
        with pytest.raises(LinkLostError, match="the driver failed: 'a mistake'"):
            link.read(WAIT_S)
    again = shared.open("a")
    a.close()
    b.close()
    talker.send(b"good")
    assert again.read(WAIT_S) == b"good"
    again.close()


def test_a_device_whose_thread_is_busy_keeps_the_newest_datagrams():
    port = free_port()
    shared = SharedUdp("127.0.0.1", port, everything)
    slow, quick = shared.open("a"), shared.open("b")
    talker = UdpWire(("127.0.0.1", port))
    for k in range(MOST_WAITING + 50):
        talker.send(str(k).encode())
        assert quick.read(WAIT_S) == str(k).encode()
    assert slow.read(WAIT_S) == b"50"
    slow.close()
    quick.close()


@pytest.mark.parametrize(
    ("devices", "problem"),
    [
        ({"a": COMPASS, "b": COMPASS}, "both speak nmea0183; state the address"),
        (
            {"a": AUTOPILOT, "b": {**SONAR, "component_id": 1}},
            "both use system 1, component 1; state the address",
        ),
        (
            {"a": {**COMPASS, "sender": "10.0.0.1"}, "b": {**COMPASS, "sender": "10.0.0.1"}},
            "both speak nmea0183",
        ),
        ({"a": {**COMPASS, "sender": "10.0.0"}}, "10.0.0"),
        ({"a": {**COMPASS, "sender": "10.0.0.1:x"}}, "x"),
    ],
)
def test_devices_that_nobody_can_tell_apart_are_refused_in_words(devices, problem):
    with pytest.raises(ConfigError, match=problem):
        parse_telemetry(config(10110, **devices), "rov.yaml")


def test_one_port_on_all_addresses_and_on_one_is_refused():
    wanted = config(10110, a=COMPASS, b={"kind": "pd0"})
    wanted["devices"]["a"]["link"]["host"] = "0.0.0.0"
    with pytest.raises(
        ConfigError, match="'devices' has 'a' and 'b' on one UDP port: give both the"
    ):
        parse_telemetry(wanted, "rov.yaml")
    wanted["devices"]["a"]["link"]["host"] = "127.0.0.2"
    assert parse_telemetry(wanted, "rov.yaml").devices.keys() == {"a", "b"}


def test_devices_that_something_tells_apart_are_accepted():
    six = {"kind": "nmea0183", "sender": "[fe80::1]:7"}
    wanted = config(10110, a=COMPASS, b={**COMPASS, "sender": "10.0.0.1"}, c=AUTOPILOT, d=six)
    parsed = parse_telemetry(wanted, "rov.yaml")
    addresses = [device.link.sender_address for device in parsed.devices.values()]
    assert addresses == [None, ("10.0.0.1", None), None, ("fe80::1", 7)]


def test_a_sender_belongs_to_who_listens():
    link = {"kind": "udp", "mode": "send", "host": "10.0.0.1", "port": 1, "sender": "10.0.0.1"}
    with pytest.raises(ConfigError, match="sender belongs to mode listen"):
        parse_telemetry({"devices": {"a": {"kind": "pd0", "link": link}}}, "rov.yaml")
