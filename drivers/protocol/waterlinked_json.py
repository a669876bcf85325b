"""A Water Linked DVL on TCP: one JSON object per line, no checksum."""

from __future__ import annotations

import json
import math
import re
from typing import Any

from aquaflow.config.instruments import WaterLinkedJsonConfig
from aquaflow.drivers.protocol.packets import LineFraming, PacketDecoder
from aquaflow.drivers.samples import from_euler
from aquaflow.types import Altitude, Attitude, TelemetrySample, Velocity

LONGEST = 16_384
"""Bytes; a velocity report has about 1000, answers to commands a few times that."""
START = re.compile(rb"(?<=[\r\n])\{")
"""A report begins on a line of its own."""


def parse(line: bytes) -> dict[str, Any] | None:
    """The object on a line; None where there is none."""
    try:
        value = json.loads(line)
    # A thousand opening brackets are as little an object as a wrong letter is.
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


class JsonFraming(LineFraming):
    """Objects start lines only: the inner ones of a damaged line are not tried one by one."""

    def __init__(self) -> None:
        super().__init__(b"{", LONGEST, lambda line: parse(line) is not None)

    def find(self, buffer: bytes, at: int) -> int:
        if at == 0 and buffer.startswith(b"{"):
            return 0
        found = START.search(buffer, at)
        return found.start() if found else -1


class WaterLinkedJsonDecoder(PacketDecoder):
    """Objects of type velocity, and position_local where its attitude is asked for."""

    def __init__(self, name: str, config: WaterLinkedJsonConfig) -> None:
        super().__init__(name, JsonFraming())
        self._attitude = config.attitude

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        report = parse(packet)
        assert report is not None
        kind = report.get("type")
        if kind == "velocity":
            return self._velocity(report, arrival_ns)
        if kind == "position_local" and self._attitude:
            roll, pitch, yaw = (_number(report[key]) for key in ("roll", "pitch", "yaw"))
            return [attitude(arrival_ns, self.source("position_local"), roll, pitch, yaw)]
        return []

    def _velocity(self, report: dict[str, Any], arrival_ns: int) -> list[TelemetrySample]:
        validity, sent = report.get("time_of_validity"), report.get("time_of_transmission")
        t_ns = arrival_ns
        if isinstance(validity, int) and isinstance(sent, int):  # firmware before 2.2 has neither
            t_ns = measured_ns(arrival_ns, validity, sent)
        velocity = None
        if report["velocity_valid"] is True:
            velocity = (_number(report["vx"]), _number(report["vy"]), _number(report["vz"]))
        else:
            self.counters.invalid_values += 1
        return bottom_track(
            t_ns, arrival_ns, self.source("velocity"), velocity, _number(report["fom"]),
            _number(report["altitude"]),
        )  # fmt: skip


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return float(value)


# --------------------------------------------------------------------------------------------------
# Common parts of Water Linked's two protocols (github.com/waterlinked/docs, docs/dvl).
#
# Axes are x forward, y starboard, z down, as the body's; a bracket that points the DVL backwards is
# the mounting's business.

NO_BOTTOM_M = -1.0
"""Altitude where the DVL sees no bottom."""
MAX_LATENCY_US = 1_000_000
"""A measurement is sent within 0.1 s; a longer delay means that one of its two times is wrong."""


def measured_ns(arrival_ns: int, validity_us: int, transmission_us: int) -> int:
    """The DVL's clock is arbitrary, but the time it reports from measurement to sending is not."""
    latency_us = transmission_us - validity_us
    return arrival_ns - latency_us * 1000 if 0 < latency_us <= MAX_LATENCY_US else arrival_ns


def bottom_track(
    t_ns: int,
    arrival_ns: int,
    source: str,
    velocity: tuple[float, float, float] | None,
    merit: float,
    altitude: float,
) -> list[TelemetrySample]:
    """Velocity, unless the DVL calls it invalid, and altitude, unless it sees no bottom."""
    samples: list[TelemetrySample] = []
    if velocity is not None:
        samples.append(Velocity(t_ns, arrival_ns, source, velocity, merit))
    if altitude > NO_BOTTOM_M:
        samples.append(Altitude(t_ns, arrival_ns, source, altitude))
    return samples


def attitude(arrival_ns: int, source: str, roll: float, pitch: float, yaw: float) -> Attitude:
    """Of the dead reckoning; degrees."""
    angles = (math.radians(value) for value in (roll, pitch, yaw))
    return Attitude(arrival_ns, arrival_ns, source, from_euler(*angles))
