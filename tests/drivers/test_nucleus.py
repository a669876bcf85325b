"""Nortek's Nucleus: thousands of packets by an encoder of the documented layout, login and start.

What that encoder writes was read by Nortek's own parser (nucleus_driver 1.7.8) as it was meant.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from threading import Event
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config.instruments import NucleusConfig
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.drivers.protocol.nucleus import PATIENCE_NS, NucleusDecoder, checksum
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.nucleus import Nucleus, packet, sum_words
from aquaflow.sim_drivers.devices.wires import TcpWire
from aquaflow.types import Acceleration, Altitude, AngularRate, Attitude, Depth, Velocity
from tests.drivers.simulated_links import endless, motion, until

COUNT = 2000
NOW = 80_000_000_000
US = 12_345_678
LINK = {"kind": "serial", "port": "/dev/null"}
ALL = ["bottom_track", "altimeter", "ahrs", "imu", "fast_pressure"]
Case = tuple[bytes, list[tuple[type, tuple[float, ...]]]]
"""A packet, and the values that it holds, by kind of sample."""


def nucleus(**settings: Any) -> NucleusDecoder:
    return NucleusDecoder("dvl", NucleusConfig.model_validate({"link": LINK, **settings}))


def singles(draw: random.Random, count: int, most: float) -> list[float]:
    """Numbers that 32 bits hold exactly."""
    numbers = [draw.uniform(-most, most) for _ in range(count)]
    return [
        float(value) for value in struct.unpack(f"{count}f", struct.pack(f"{count}f", *numbers))
    ]


def bottom_track(draw: random.Random) -> Case:
    status = draw.choice([0x7FFF, 0x7FFF, draw.randrange(0x8000)])
    velocity, merits = singles(draw, 3, 3.0), [abs(v) for v in singles(draw, 3, 0.2)]
    fixed = b"SN  " + bytes(4) + struct.pack("<18f", *singles(draw, 18, 5.0))
    data = packet(0xB4, US, status, fixed + struct.pack("<6f", *velocity, *merits), bytes(8))
    good = status & 0x7E00 == 0x7E00
    return data, [(Velocity, (*velocity, max(merits)))] if good else []


def altimeter(draw: random.Random) -> Case:
    status, (distance, *rest) = draw.randrange(4), singles(draw, 4, 40.0)
    fixed = b"SN  " + bytes(4) + struct.pack("<4f", *rest, abs(distance))
    good = bool(status & 1)
    return packet(0xAA, US, status, fixed, bytes(2)), [(Altitude, (abs(distance),))] if good else []


def ahrs(draw: random.Random) -> Case:
    roll, pitch = singles(draw, 2, 80.0)
    heading, depth = draw.randrange(36000) / 128.0, draw.randrange(4000) / 16.0
    version = draw.choice([1, 2])  # figures of merit as bytes, or as numbers
    values = struct.pack("<18f", roll, pitch, heading, *singles(draw, 14, 1.0), depth)
    data = packet(0xD2, US, 0, bytes(12 if version == 1 else 20), values, version)
    return data, [(Attitude, (roll, pitch, heading)), (Depth, (depth,))]


def imu(draw: random.Random) -> Case:
    status = draw.choice([1, 1, 0, 1 << 17])
    force, rate = singles(draw, 3, 20.0), singles(draw, 3, 4.0)
    data = packet(0x82, US, status, b"", struct.pack("<7f", *force, *rate, 20.0))
    expected = [(Acceleration, tuple(force)), (AngularRate, tuple(rate))]
    return data, expected if status & 1 else []


def fast_pressure(draw: random.Random) -> Case:
    (decibar,) = (abs(value) + 10.0 for value in singles(draw, 1, 300.0))
    sent = float(np.float32(decibar))
    return (
        packet(0x96, US, 1, b"", struct.pack("<f", decibar)),
        [(Depth, ((sent * 1e4 - 101_325.0) / (1029.0 * 9.80665),))],
    )


def value_of(sample: Any) -> Any:
    match sample:
        case Velocity():
            return (*sample.velocity_m_s, sample.figure_of_merit_m_s)
        case Altitude():
            return (sample.altitude_m,)
        case Depth():
            return (sample.depth_m,)
        case Acceleration():
            return sample.acceleration_m_s2
        case AngularRate():
            return sample.rate_rad_s
        case Attitude():
            yaw, pitch, roll = Rotation.from_quat(np.roll(sample.wxyz, -1)).as_euler("ZYX")
            return tuple(math.degrees(a) for a in (roll, pitch, yaw % math.tau))
    raise AssertionError(sample)


@pytest.mark.parametrize("drawn", [bottom_track, altimeter, ahrs, imu, fast_pressure])
def test_every_packet_is_what_was_encoded(drawn: Callable[[random.Random], Case]) -> None:
    draw = random.Random(drawn.__name__)
    receiver = nucleus(packets=[drawn.__name__])
    mismatches = bad = 0
    for _ in range(COUNT):
        data, expected = drawn(draw)
        found = [(type(s), value_of(s)) for s in receiver.feed(data, NOW)]
        bad += not expected
        mismatches += [kind for kind, _ in found] != [kind for kind, _ in expected] or any(
            not np.allclose(a, b, rtol=1e-9, atol=1e-9)
            for (_, a), (_, b) in zip(found, expected, strict=True)
        )
    assert mismatches == 0
    counters = receiver.counters
    assert (counters.messages, counters.invalid_values) == (COUNT, bad)
    assert (counters.bad_checksums, counters.garbage_bytes) == (0, 0)


def test_the_checksum_is_the_documented_one() -> None:
    draw = random.Random(5)
    for _ in range(300):
        data = draw.randbytes(draw.randrange(40))
        assert checksum(data) == sum_words(data)


def test_packets_that_are_not_asked_for_are_counted_only() -> None:
    receiver = nucleus(packets=["altimeter"])
    assert receiver.feed(imu(random.Random(1))[0], NOW) == []
    assert (receiver.counters.messages, receiver.counters.invalid_values) == (1, 0)


def test_with_fast_pressure_the_ahrs_states_no_depth() -> None:
    data, _ = ahrs(random.Random(1))
    assert [type(s) for s in nucleus().feed(data, NOW)] == [Attitude, Depth]
    assert [type(s) for s in nucleus(packets=ALL).feed(data, NOW)] == [Attitude]


def test_an_instrument_that_sends_nothing_is_started_again_and_again() -> None:
    receiver = nucleus()
    assert receiver.outgoing(NOW) == b""
    assert receiver.outgoing(NOW + PATIENCE_NS) == b"START\r\n"
    receiver.feed(imu(random.Random(1))[0], NOW + PATIENCE_NS + 1)
    assert receiver.outgoing(NOW + 2 * PATIENCE_NS) == b""
    assert receiver.outgoing(NOW + 2 * PATIENCE_NS + 1) == b"START\r\n"
    silent = nucleus(start=False)
    assert [silent.outgoing(NOW + k * PATIENCE_NS) for k in range(4)] == [b""] * 4


def test_the_password_is_said_where_it_is_asked_for() -> None:
    receiver = nucleus(password="secret")
    prompt = b"\r\nPlease enter password:\r\n"
    receiver.feed(prompt[:12], NOW)
    assert receiver.outgoing(NOW) == b""
    receiver.feed(prompt[12:], NOW)
    assert receiver.outgoing(NOW) == b"secret\r\n"
    assert receiver.outgoing(NOW) == b""


def test_a_simulated_nucleus_on_tcp_is_logged_into_and_started(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("aquaflow.drivers.protocol.nucleus.PATIENCE_NS", 200_000_000)
    wire, device, enough = TcpWire(), Nucleus(password="nortek", measures=False), Event()
    link = {"kind": "tcp", "host": "127.0.0.1", "port": wire.port}
    config = {"devices": {"dvl": {"kind": "nucleus", "link": link}}}
    telemetry = LinkTelemetry(parse_telemetry(config, "test"))
    until(lambda: telemetry.links["dvl"].is_open)
    simulated = SimulatedDevice(device, wire, endless(motion(), enough), 1.0).start()
    until(lambda: telemetry.counters()["dvl"].samples > 20)
    enough.set()
    telemetry.close()
    simulated.close()
    assert device.commands[0] == b"nortek"
    assert b"START" in device.commands
    assert {type(s) for s in telemetry.samples()} >= {Velocity, Attitude, Depth}
