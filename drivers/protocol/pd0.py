"""Bottom track of a Teledyne DVL that sends PD0 ensembles (Teledyne's PD0 output data format).

Ship and instrument axes are x starboard, y forward, z up; those of beams and of the earth are
brought into them where the ensemble tells how (:mod:`aquaflow.drivers.protocol.pd0_axes`).
"""

from __future__ import annotations

import calendar
import logging
import struct
from datetime import datetime

from aquaflow.config.instruments import Pd0Config
from aquaflow.drivers.device_clock import DeviceClock
from aquaflow.drivers.events import about
from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing, PacketDecoder
from aquaflow.drivers.protocol.pd0_axes import (
    BAD_VELOCITY,
    Pd0Head,
    UnusableError,
    from_beams,
    from_earth,
)
from aquaflow.types import Altitude, TelemetrySample, Velocity

log = logging.getLogger(__name__)

MARK = b"\x7f\x7f"
"""Header ID and data source ID."""
HEADER = 6
"""Bytes: the mark, the ensemble's length, a spare one, the number of data types."""
CHECKSUM = 2
"""Bytes: the sum of all before, modulo 65536."""
LONGEST = 8192
"""Bytes; a water profile of 128 cells has about 3000."""
MAX_TYPES = 16
"""Data types of an ensemble. A DVL sends seven or so; a larger number is damage."""
FIXED_LEADER, VARIABLE_LEADER, BOTTOM_TRACK = 0x0000, 0x0080, 0x0600
"""IDs of the data types that are read."""
COORDINATES = ("beam", "instrument", "ship", "earth")
"""By bits 3 and 4 of the fixed leader's byte 25."""
MIN_BEAMS = 3
"""With three of four beams the velocity and the mean range are still right."""


class Pd0Framing(Framing):
    """An ensemble: header with the offsets of its parts, the parts, a sum of all bytes."""

    longest = LONGEST

    def find(self, buffer: bytes, at: int) -> int:
        found = buffer.find(MARK, at)
        if found < 0 and buffer.endswith(MARK[:1]):
            return len(buffer) - 1
        return found

    def length(self, buffer: bytes, at: int) -> int:
        if len(buffer) - at < HEADER:
            return INCOMPLETE
        size, types = struct.unpack_from("<HxB", buffer, at + 2)
        if not 1 <= types <= MAX_TYPES or size + CHECKSUM > LONGEST:
            return NO_PACKET
        first = HEADER + 2 * types
        if len(buffer) - at < first:
            return INCOMPLETE
        offsets = struct.unpack_from(f"<{types}H", buffer, at + HEADER)
        in_order = list(offsets) == sorted(set(offsets))
        if not in_order or offsets[0] < first or offsets[-1] + 2 > size:
            return NO_PACKET
        return int(size) + CHECKSUM

    def intact(self, packet: bytes) -> bool:
        (sent,) = struct.unpack_from("<H", packet, len(packet) - CHECKSUM)
        return sum(packet[:-CHECKSUM]) & 0xFFFF == int(sent)


class Pd0Decoder(PacketDecoder):
    """Velocity over ground and altitude."""

    def __init__(self, name: str, config: Pd0Config) -> None:
        super().__init__(name, Pd0Framing())
        self.clock: DeviceClock = DeviceClock(name)
        self._sign = -1.0 if config.velocity_of == "bottom" else 1.0
        self._sigma_m_s = config.sigma_m_s
        self._beam_angle_deg = config.beam_angle_deg
        self._said_unused = False

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        parts = _parts(packet)
        bottom = parts[BOTTOM_TRACK]
        t_ns = self._moment(parts[VARIABLE_LEADER], arrival_ns)
        source = self.source("bottom_track")
        samples: list[TelemetrySample] = []
        if (altitude_m := _altitude(bottom)) is not None:
            samples.append(Altitude(t_ns, arrival_ns, source, altitude_m))
        try:
            x, y, z, error = self._in_instrument_axes(parts)
        except ValueError as problem:
            self.counters.invalid_values += 1
            if isinstance(problem, UnusableError):
                self._say_unused(parts[FIXED_LEADER], problem)
            return samples
        velocity = tuple(self._sign * 1e-3 * value for value in (y, x, -z))
        # The error velocity is scaled so that its spread is that of the horizontal velocity.
        merit = (self._sigma_m_s**2 + (1e-3 * error) ** 2) ** 0.5
        return [
            Velocity(t_ns, arrival_ns, source, (velocity[0], velocity[1], velocity[2]), merit),
            *samples,
        ]

    def _in_instrument_axes(self, parts: dict[int, bytes]) -> tuple[float, float, float, float]:
        """x, y, z and error velocity, mm/s; ValueError where they were not measured."""
        one, two, three, four = struct.unpack_from("<4h", parts[BOTTOM_TRACK], 24)
        coordinates = _coordinates(parts[FIXED_LEADER])
        if coordinates == "beam":
            head = Pd0Head.of(parts[FIXED_LEADER])
            return from_beams((one, two, three, four), head, self._beam_angle_deg)
        if BAD_VELOCITY in (one, two, three):
            raise ValueError("no velocity over ground")
        error = 0.0 if four == BAD_VELOCITY else float(four)
        if coordinates == "earth":
            head, leader = Pd0Head.of(parts[FIXED_LEADER]), parts[VARIABLE_LEADER]
            return (*from_earth((one, two, three), head, leader), error)
        return one, two, three, error

    def _say_unused(self, leader: bytes, problem: UnusableError) -> None:
        if not self._said_unused:
            self._said_unused = True
            log.warning(
                "%s: its velocities, in %s coordinates, are not used: %s; set the DVL to ship "
                "coordinates (EX10000 and the like)",
                self.name, _coordinates(leader), problem, extra=about(self.name, "unused"),
            )  # fmt: skip

    def _moment(self, leader: bytes, arrival_ns: int) -> int:
        """When the ensemble was pinged, by the clock of the DVL."""
        year, month, day, hour, minute, second, hundredths = leader[4:11]
        try:
            date = datetime(2000 + year, month, day, hour, minute, second)
        except ValueError:
            return arrival_ns  # a clock that was never set need not cost the velocity
        device_ns = calendar.timegm(date.timetuple()) * 1_000_000_000 + hundredths * 10_000_000
        return self.clock.stamp(device_ns, arrival_ns)


def _coordinates(leader: bytes) -> str:
    return COORDINATES[leader[25] >> 3 & 0b11]


def _parts(packet: bytes) -> dict[int, bytes]:
    """The parts of an ensemble by their identifier."""
    offsets = struct.unpack_from(f"<{packet[5]}H", packet, HEADER)
    ends = (*offsets[1:], len(packet) - CHECKSUM)
    return {
        struct.unpack_from("<H", packet, start)[0]: packet[start:end]
        for start, end in zip(offsets, ends, strict=True)
    }


def _altitude(bottom: bytes) -> float | None:
    """Mean vertical range, metres; a range of 0 is a beam that saw no bottom."""
    low = struct.unpack_from("<4H", bottom, 16)
    high = bottom[77:81] or bytes(4)  # old firmware ends before
    ranges = [lsb + (msb << 16) for lsb, msb in zip(low, high, strict=True)]
    seen = [centimetres / 100.0 for centimetres in ranges if centimetres > 0]
    return sum(seen) / len(seen) if len(seen) >= MIN_BEAMS else None
