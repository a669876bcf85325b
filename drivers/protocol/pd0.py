"""Bottom track of a Teledyne DVL that sends PD0 ensembles (Teledyne's PD0 output data format).

Ship and instrument axes are x starboard, y forward, z up; those of beams and of the earth are
brought into them where the ensemble tells how (:mod:`aquaflow.drivers.protocol.pd0`).
"""

from __future__ import annotations

import calendar
import logging
import math
import struct
from datetime import datetime
from typing import NamedTuple

from aquaflow.config.instruments import Pd0Config
from aquaflow.drivers.link import DeviceClock, about
from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing, PacketDecoder
from aquaflow.drivers.samples import Vector, from_euler, inverse, rotate
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


# --------------------------------------------------------------------------------------------------
# Velocities in a Teledyne DVL's own axes, from those along its beams or in those of the earth.
#
# Instrument axes of a head that looks down: x from beam 1 to beam 2 (starboard), y from beam 4 to
# beam 3 (forward), z towards its face (up). Teledyne RD Instruments, "ADCP Coordinate
# Transformation: Formulas and Calculations" (P/N 951-6079-00); fields by its Pathfinder DVL Guide
# (2018), tables 33, 34 and 40.

BEAM_ANGLES_DEG = (15.0, 20.0, 30.0, None)
"""By bits 8 and 9 of the system's configuration; the last: another."""
CONVEX, FACES_UP = 0x08, 0x80
"""Bits of that configuration."""
JANUS = (0b0100, 0b0101, 0b1111)
"""Its bits 12 to 15 where four beams lean out to four sides, with or without a fifth between."""
TILTS_USED = 0x04
"""Bit of the coordinates: pitch and roll were used on the way to ship or earth axes."""
BAD_VELOCITY = -32_768
"""mm/s; what the DVL writes for a velocity that it could not measure."""
CENTIDEGREE = math.pi / 18_000.0
"""rad."""


class UnusableError(ValueError):
    """Why velocities cannot be brought into instrument axes, and what to set."""


class Pd0Head(NamedTuple):
    """What the fixed leader says of the head."""

    configuration: int
    tilts_used: bool
    alignment_deg: float
    """EA: from beam 3 to the ship's bow."""

    @classmethod
    def of(cls, leader: bytes) -> Pd0Head:
        """From the fixed leader, 29 bytes of it at least."""
        (configuration,) = struct.unpack_from("<H", leader, 4)
        (alignment,) = struct.unpack_from("<h", leader, 26)
        return cls(configuration, bool(leader[25] & TILTS_USED), alignment * 0.01)

    def beam_angle(self, known_deg: float | None) -> float:
        """Between each beam and the head's axis, rad; ``known_deg`` is that of the config."""
        if self.configuration & FACES_UP:
            raise UnusableError("it faces up")
        stated_deg = BEAM_ANGLES_DEG[self.configuration >> 8 & 0b11]
        if self.configuration >> 12 not in JANUS:
            stated_deg = None
        angle_deg = known_deg or stated_deg
        if angle_deg is None:
            raise UnusableError(
                "it does not state the angle of its beams, and nor does beam_angle_deg"
            )
        return math.radians(angle_deg)


def from_beams(
    beams: tuple[int, int, int, int], head: Pd0Head, known_deg: float | None
) -> tuple[float, float, float, float]:
    """x, y, z and error velocity from those towards beams 1 to 4, all in their unit; the error is
    0 where one beam is bad and the three others tell the velocity.

    Raises:
        UnusableError: the head's geometry is not known.
        ValueError: more than one beam is bad.
    """
    angle = head.beam_angle(known_deg)
    one, two, three, four = _complete(beams)
    a, b = 1.0 / (2.0 * math.sin(angle)), 1.0 / (4.0 * math.cos(angle))
    c = 1.0 if head.configuration & CONVEX else -1.0
    error = (one + two - three - four) * a / math.sqrt(2.0)
    return c * a * (one - two), c * a * (four - three), b * (one + two + three + four), error


def from_earth(velocity: Vector, head: Pd0Head, leader: bytes) -> Vector:
    """x, y, z from east, north, up, by the heading and tilts of the variable leader, with which
    the DVL turned them: what is wrong with its compass cancels.

    Raises:
        UnusableError: the head is turned against the ship, or faces up.
    """
    if head.configuration & FACES_UP:
        raise UnusableError("it faces up")
    if head.alignment_deg:
        raise UnusableError(
            f"its heading alignment (EA) of {head.alignment_deg:g} degrees may or may not be in "
            "its heading"
        )
    heading, tilt_1, tilt_2 = struct.unpack_from("<Hhh", leader, 18)
    pitch, roll = 0.0, 0.0
    if head.tilts_used:
        # Tilt 1 leans in the head's own plane, which roll has turned out of the vertical.
        roll = tilt_2 * CENTIDEGREE
        pitch = math.atan(math.tan(tilt_1 * CENTIDEGREE) * math.cos(roll))
    q = from_euler(roll, pitch, heading * CENTIDEGREE)
    east, north, up = velocity
    forward, right, down = rotate(inverse(q), (north, east, -up))
    return right, forward, -down


def _complete(beams: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """With a bad one replaced by what makes the error velocity 0."""
    bad = [k for k, value in enumerate(beams) if value == BAD_VELOCITY]
    if not bad:
        return beams
    if len(bad) > 1:
        raise ValueError("the velocity needs three beams")
    whole = list(beams)
    (k,) = bad
    pair, others = (0, 1) if k < 2 else (2, 3), (2, 3) if k < 2 else (0, 1)
    partner = pair[0] + pair[1] - k
    whole[k] = whole[others[0]] + whole[others[1]] - whole[partner]
    return whole[0], whole[1], whole[2], whole[3]
