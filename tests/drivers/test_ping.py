"""The Ping protocol: thousands of messages by Blue Robotics' own encoder, and who asks for what."""

from __future__ import annotations

import logging
import random
from importlib import import_module
from typing import Any

import pytest

from aquaflow.config.instruments import PingConfig
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.drivers.protocol.ping import ANSWER_NS, STREAM_NS, PingDecoder, message
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.ping import Ping1D, frame
from aquaflow.sim_drivers.devices.wires import UdpWire
from aquaflow.types import Altitude
from tests.drivers.simulated_links import motion, until

brping: Any = import_module("brping")
COUNT = 3000
NOW = 70_000_000_000
LINK = {"kind": "serial", "port": "/dev/null"}


def sounder(**settings: Any) -> PingDecoder:
    return PingDecoder("ping", PingConfig.model_validate({"link": LINK, **settings}))


def encoded(kind: str, **fields: Any) -> bytes:
    names = import_module("brping.definitions")
    # The table of all devices has the S500's names for 1211.
    made = brping.PingMessage(
        getattr(names, f"PING1D_{kind.upper()}"), payload_dict=names.payload_dict_ping1d
    )
    for name, value in fields.items():
        setattr(made, name, value)
    made.pack_msg_data()
    return bytes(made.msg_data)


@pytest.mark.parametrize("kind", ["distance_simple", "distance", "profile"])
def test_every_distance_is_what_the_makers_encoder_packed(kind: str) -> None:
    draw, receiver = random.Random(kind), sounder()
    mismatches = invalid = measured = 0
    for _ in range(COUNT):
        distance_mm = draw.choice([0, draw.randint(1, 100_000), draw.randint(1, 100_000)])
        confidence = draw.randint(0, 100)
        again = kind != "distance_simple" and measured > 0 and draw.random() < 0.1
        measured += not again
        fields: dict[str, Any] = {"distance": distance_mm, "confidence": confidence}
        if kind != "distance_simple":
            fields |= {"transmit_duration": draw.randint(0, 2000), "ping_number": measured,
                       "scan_start": draw.randint(0, 9000), "scan_length": 50_000,
                       "gain_setting": draw.randint(0, 6)}  # fmt: skip
        if kind == "profile":
            points = draw.randbytes(draw.choice([1, 200, 1200]))
            fields |= {"profile_data_length": len(points), "profile_data": bytearray(points)}
        good = confidence >= 50 and distance_mm > 0 and not again
        invalid += not good and not again
        expected = [Altitude(NOW, NOW, f"ping/{kind}", distance_mm / 1000.0)] if good else []
        mismatches += receiver.feed(encoded(kind, **fields), NOW) != expected
    assert mismatches == 0
    counters = receiver.counters
    assert (counters.messages, counters.invalid_values) == (COUNT, invalid)
    assert (counters.bad_checksums, counters.garbage_bytes) == (0, 0)


def test_a_request_is_the_published_one() -> None:
    assert message(6, 5).hex(" ") == "42 52 02 00 06 00 00 00 05 00 a1 00"


def test_other_messages_are_counted_and_nothing_else() -> None:
    version = bytes.fromhex("42 52 04 00 05 00 00 00 01 02 03 00 a3 00")  # published
    receiver = sounder()
    assert receiver.feed(version, NOW) == []
    assert (receiver.counters.messages, receiver.counters.invalid_values) == (1, 0)


def test_a_request_waits_for_its_answer_and_is_made_again_without_one() -> None:
    receiver = sounder(ask_for="distance_simple", interval_s=0.2)
    request = message(6, 1211)

    assert receiver.outgoing(NOW) == request
    assert receiver.outgoing(NOW + ANSWER_NS - 1) == b""
    later = NOW + ANSWER_NS
    assert receiver.outgoing(later) == request
    receiver.feed(encoded("distance_simple", distance=1000, confidence=90), later + 1)
    assert receiver.outgoing(later + 199_999_999) == b""
    assert receiver.outgoing(later + 200_000_000) == request


def test_a_stream_is_started_once_and_again_where_it_stopped() -> None:
    receiver = sounder(ask_for="stream")
    start = message(1400, 1300)
    profile = frame(1300, Ping1D(streams=True).encode(Altitude(0, 0, "log", 2.0), 0, 0)[0][8:-2])

    assert receiver.outgoing(NOW) == start
    assert len(receiver.feed(profile, NOW + STREAM_NS - 1)) == 1
    assert receiver.outgoing(NOW + STREAM_NS) == b""
    assert receiver.outgoing(NOW + 2 * STREAM_NS) == start


def test_who_only_listens_asks_nothing() -> None:
    receiver = sounder(ask_for=None)
    assert receiver.outgoing(NOW) == b""
    assert len(receiver.feed(encoded("distance_simple", distance=1000, confidence=90), NOW)) == 1
    assert receiver.outgoing(NOW + 10**12) == b""


def test_a_refusal_is_said_once_in_the_sounders_words(caplog: pytest.LogCaptureFixture) -> None:
    receiver = sounder(ask_for="stream")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            assert receiver.feed(frame(2, b"\x78\x05unknown id\0"), NOW) == []
    [record] = caplog.records
    assert record.getMessage() == "ping: the sounder refuses message 1400: unknown id"
    assert receiver.counters.invalid_values == 3


def test_a_simulated_sounder_behind_a_bridge_is_asked_for_each_distance() -> None:
    wire, device = UdpWire(), Ping1D()
    link = {"kind": "udp", "mode": "send", "host": "127.0.0.1", "port": wire.port}
    config = {"devices": {"ping": {"kind": "ping", "link": link, "interval_s": 0.0}}}
    telemetry = LinkTelemetry(parse_telemetry(config, "test"))
    simulated = SimulatedDevice(device, wire, motion(), 1.0).start()
    until(simulated.finished.is_set)
    until(lambda: telemetry.counters()["ping"].samples > 5)
    telemetry.close()
    simulated.close()

    heard = [s.altitude_m for s in telemetry.samples() if isinstance(s, Altitude)]
    truth = [s.altitude_m for s in motion() if isinstance(s, Altitude)]
    assert len(heard) <= len(truth), "no measurement is heard twice"
    assert all(min(abs(a - b) for b in truth) < 1e-3 for a in heard)
    assert device.requests >= len(heard)
    assert telemetry.counters()["ping"].invalid_values <= 1  # before the first measurement


def test_a_simulated_sounder_is_told_to_stream() -> None:
    wire, device = UdpWire(), Ping1D()
    link = {"kind": "udp", "mode": "send", "host": "127.0.0.1", "port": wire.port}
    config = {"devices": {"ping": {"kind": "ping", "link": link, "ask_for": "stream"}}}
    telemetry = LinkTelemetry(parse_telemetry(config, "test"))
    simulated = SimulatedDevice(device, wire, motion(), 1.0).start()
    until(lambda: device.streams and simulated.finished.is_set())
    until(lambda: telemetry.counters()["ping"].samples > 0)
    telemetry.close()
    simulated.close()
    assert device.requests == 0
