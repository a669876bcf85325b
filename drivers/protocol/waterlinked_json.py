"""A Water Linked DVL on TCP: one JSON object per line, no checksum."""

from __future__ import annotations

import json
import re
from typing import Any

from aquaflow.config.instruments import WaterLinkedJsonConfig
from aquaflow.drivers.protocol.lines import LineFraming
from aquaflow.drivers.protocol.packets import PacketDecoder
from aquaflow.drivers.protocol.waterlinked import attitude, bottom_track, measured_ns
from aquaflow.types import TelemetrySample

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
