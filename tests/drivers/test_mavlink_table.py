"""Thousands of MAVLink messages, packed by pymavlink, of senders other than the autopilot."""

from __future__ import annotations

import logging
import random
from collections.abc import Callable
from importlib import import_module
from typing import Any

import pytest

from aquaflow.config.telemetry import MavlinkConfig
from aquaflow.drivers.protocol.mavlink import MavlinkDecoder
from aquaflow.types import Altitude, AngularRate, Position, TelemetrySample, UtcTime, Velocity

DIALECT: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
COUNT = 2000
NOW = 50_000_000_000
LINK = {"kind": "udp", "port": 14550}
UERE_M = 5.1


def decoder(**settings: Any) -> MavlinkDecoder:
    return MavlinkDecoder("rov", MavlinkConfig.model_validate({"link": LINK, **settings}))


def distance(draw: random.Random) -> tuple[dict[str, Any], list[tuple[Any, ...]]]:
    cm = draw.randint(20, 5000)
    fields = {"time_boot_ms": draw.randint(0, 2**32 - 1), "min_distance": 20, "type": 1, "id": 0,
              "max_distance": 5000, "current_distance": cm, "orientation": 25,
              "covariance": 0}  # fmt: skip
    return fields, [(Altitude, pytest.approx(cm / 100.0))]


def gps_input(draw: random.Random) -> tuple[dict[str, Any], list[tuple[Any, ...]]]:
    lat, lon = draw.randint(-890_000_000, 890_000_000), draw.randint(-(10**9), 10**9)
    accuracy_m, hdop = draw.uniform(0.1, 9.0), draw.uniform(0.5, 9.0)
    flags, fix = draw.choice([0, 2, 64, 66]), draw.choice([0, 1, 2, 3, 4, 5, 6])
    fields = {"time_usec": 0, "gps_id": 0, "ignore_flags": flags, "time_week_ms": 0, "time_week": 0,
              "fix_type": fix, "lat": lat, "lon": lon, "alt": 0.0, "hdop": hdop, "vdop": 1.0,
              "vn": 0, "ve": 0, "vd": 0, "speed_accuracy": 0, "horiz_accuracy": accuracy_m,
              "vert_accuracy": 0, "satellites_visible": 9}  # fmt: skip
    of_hdop = (2.0 if flags & 2 else hdop) * UERE_M / 2**0.5
    sigma_m = of_hdop if flags & 64 else accuracy_m
    expected = (Position, pytest.approx((lat / 1e7, lon / 1e7, sigma_m), rel=1e-6))
    return fields, [expected] if fix >= 3 else []


def vision(draw: random.Random) -> tuple[dict[str, Any], list[tuple[Any, ...]]]:
    dt_us = draw.randint(10_000, 500_000)
    move = [draw.uniform(-0.2, 0.2) for _ in range(3)]
    turn = [draw.uniform(-0.05, 0.05) for _ in range(3)]
    fields = {"time_usec": draw.randint(0, 2**40), "time_delta_usec": dt_us, "angle_delta": turn,
              "position_delta": move, "confidence": draw.uniform(1.0, 100.0)}  # fmt: skip
    v, w = ([1e6 * each / dt_us for each in delta] for delta in (move, turn))
    return fields, [
        (Velocity, pytest.approx(v, rel=1e-5, abs=1e-7), NOW - 500 * dt_us),
        (AngularRate, pytest.approx(w, rel=1e-5, abs=1e-7), NOW - 500 * dt_us),
    ]


def gps_raw(draw: random.Random) -> tuple[dict[str, Any], list[tuple[Any, ...]]]:
    lat, lon = draw.randint(-890_000_000, 890_000_000), draw.randint(-(10**9), 10**9)
    fix, accuracy_mm = draw.randint(0, 8), draw.choice([0, draw.randint(1, 20_000)])
    eph = draw.choice([0xFFFF, draw.randint(50, 900)])
    fields = {"time_usec": draw.randint(1, 10**9), "fix_type": fix, "lat": lat, "lon": lon,
              "alt": 0, "eph": eph, "epv": 0xFFFF, "vel": 0, "cog": 0, "satellites_visible": 7,
              "h_acc": accuracy_mm}  # fmt: skip
    of_hdop = (2.0 if eph == 0xFFFF else eph / 100.0) * UERE_M / 2**0.5
    sigma_m = accuracy_mm / 1000.0 or of_hdop
    expected = (Position, pytest.approx((lat / 1e7, lon / 1e7, sigma_m), rel=1e-9))
    return fields, [expected] if fix >= 3 else []


def gps2_raw(draw: random.Random) -> tuple[dict[str, Any], list[tuple[Any, ...]]]:
    fields, expected = gps_raw(draw)
    return {**fields, "dgps_numch": 0, "dgps_age": 0}, expected


def global_position(draw: random.Random) -> tuple[dict[str, Any], list[tuple[Any, ...]]]:
    lat, lon = draw.randint(-890_000_000, 890_000_000), draw.randint(-(10**9), 10**9)
    fields = {"time_boot_ms": draw.randint(0, 2**32 - 1), "lat": lat, "lon": lon, "alt": 0,
              "relative_alt": 0, "vx": 0, "vy": 0, "vz": 0, "hdg": 0}  # fmt: skip
    sigma_m = 2.0 * UERE_M / 2**0.5
    return fields, [(Position, pytest.approx((lat / 1e7, lon / 1e7, sigma_m), rel=1e-9))]


def system_time(draw: random.Random) -> tuple[dict[str, Any], list[tuple[Any, ...]]]:
    us = draw.choice([0, draw.randint(10**15, 4 * 10**15)])
    fields = {"time_unix_usec": us, "time_boot_ms": draw.randint(1, 2**31)}
    return fields, [(UtcTime, us * 1000)] if us else []


def value_of(sample: TelemetrySample) -> Any:
    match sample:
        case Altitude():
            return sample.altitude_m
        case Position():
            return (sample.latitude_deg, sample.longitude_deg, sample.sigma_m)
        case Velocity():
            return list(sample.velocity_m_s)
        case AngularRate():
            return list(sample.rate_rad_s)
        case UtcTime():
            return sample.utc_ns
    raise AssertionError(sample)


@pytest.mark.parametrize(
    ("name", "drawn", "sender", "version"),
    [
        ("distance_sensor", distance, (1, 194), 1),
        ("distance_sensor", distance, (1, 194), 2),
        ("gps_input", gps_input, (255, 220), 1),
        ("gps_input", gps_input, (255, 220), 2),
        ("vision_position_delta", vision, (255, 0), 2),  # its number is beyond MAVLink 1
        ("system_time", system_time, (7, 3), 2),
        ("gps_raw_int", gps_raw, (1, 220), 2),  # its accuracy is an extension of MAVLink 2
        ("gps2_raw", gps2_raw, (1, 220), 2),
        ("global_position_int", global_position, (2, 1), 1),
        ("global_position_int", global_position, (2, 1), 2),
    ],
)
def test_every_message_of_a_named_sender_is_what_pymavlink_packed(
    name: str,
    drawn: Callable[[random.Random], tuple[dict[str, Any], list[tuple[Any, ...]]]],
    sender: tuple[int, int],
    version: int,
) -> None:
    draw = random.Random(f"{name} {version}")
    other = {"system_id": sender[0], "component_id": sender[1], "messages": [name.upper()]}
    receiver = decoder(also=[other])
    wire = DIALECT.MAVLink(None, srcSystem=sender[0], srcComponent=sender[1])
    mismatches = 0
    for _ in range(COUNT):
        fields, expected = drawn(draw)
        message = getattr(DIALECT, f"MAVLink_{name}_message")(**fields)
        samples = receiver.feed(bytes(message.pack(wire, force_mavlink1=version == 1)), NOW)
        found = [(type(each), value_of(each), each.t_ns)[: 2 + (len(row) > 2)]
                 for each, row in zip(samples, expected, strict=False)]  # fmt: skip
        mismatches += len(samples) != len(expected) or found != expected
        assert all(each.source == f"rov/{sender[0]}.{sender[1]}/{name.upper()}" for each in samples)
    assert mismatches == 0
    assert receiver.counters.messages == COUNT
    assert receiver.counters.invalid_values == receiver.counters.unheard == 0


def test_a_sonar_that_the_config_does_not_name_is_counted_and_named_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    receiver, draw = decoder(), random.Random(1)
    wire = DIALECT.MAVLink(None, srcSystem=1, srcComponent=194)
    with caplog.at_level(logging.WARNING):
        for _ in range(919):
            fields, _ = distance(draw)
            message = DIALECT.MAVLink_distance_sensor_message(**fields)
            assert receiver.feed(bytes(message.pack(wire)), NOW) == []
    assert receiver.counters.unheard == 919
    [record] = caplog.records
    assert "{system_id: 1, component_id: 194, messages: [DISTANCE_SENSOR]}" in record.getMessage()
    told = record.fields  # type: ignore[attr-defined]
    assert told == {"event": "unheard", "source": receiver.name}


@pytest.mark.parametrize("also", [[{"component_id": 1}], [{"component_id": 9}] * 2])
def test_a_sender_is_named_once(also: list[dict[str, int]]) -> None:
    with pytest.raises(ValueError, match="each sender once"):
        decoder(also=also)


@pytest.mark.parametrize(("confidence", "dt_us"), [(0.0, 100_000), (50.0, 0)])
def test_motion_without_confidence_or_interval_is_invalid(confidence: float, dt_us: int) -> None:
    receiver = decoder(messages=["VISION_POSITION_DELTA"])
    wire = DIALECT.MAVLink(None, srcSystem=1, srcComponent=1)
    message = DIALECT.MAVLink_vision_position_delta_message(
        time_usec=1, time_delta_usec=dt_us, angle_delta=[0, 0, 0], position_delta=[0, 0, 0],
        confidence=confidence,
    )  # fmt: skip
    assert receiver.feed(bytes(message.pack(wire)), NOW) == []
    assert receiver.counters.invalid_values == 1
