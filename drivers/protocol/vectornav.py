"""A VectorNav AHRS or INS (VN-100, VN-200, VN-300): binary messages of any groups, and ASCII.

Its axes are forward, right, down and its world north-east-down; accelerations hold gravity, so that
at rest z reads -9.8 m/s^2 (VN-100 User Manual, UM001; VN-200, UM004).
"""

from __future__ import annotations

import binascii
import math
import re
import struct
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from functools import reduce
from operator import xor
from typing import NamedTuple, TypeAlias

from aquaflow.config.instruments import VectorNavConfig
from aquaflow.drivers.link import DeviceClock
from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing, PacketDecoder
from aquaflow.drivers.samples import Fixes, from_euler, normalise, sigma_of
from aquaflow.types import Acceleration, AngularRate, Attitude, TelemetrySample, UtcTime

# --------------------------------------------------------------------------------------------------
# Messages of a VectorNav on the wire: binary with the groups of fields that it was set to, ASCII.
#
# VN-100 User Manual (UM001, revision 2.22), sections 3.8 and 4.3; a VN-200 or VN-300 sends the same
# with more groups.

SYNC = 0xFA
"""First byte of a binary message."""
MARKS = re.compile(rb"[\xfa$]")
"""First bytes of messages."""
CRC = 2
"""Bytes at a binary message's end."""
LONGEST = 1024
"""Bytes; all fields of all groups have some 900."""
LONGEST_LINE = 256
"""Bytes of an ASCII message; VNISE has some 200."""
LINE = re.compile(rb"\$(VN[\x20-\x29\x2b-\x7e]*)\*([0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})[\r\n]")
"""What the checksum covers, and its digits: two of an exclusive or, or four of a CRC."""
EXTENDED_GROUPS, EXTENDED_FIELDS = 0x80, 0x8000
"""Bits that announce a further byte of groups, a further word of fields; reserved until now."""
FIELD_BYTES = (
    (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    (8, 8, 8, 2, 8, 8, 8, 4, 4, 1, 1),
    (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40),
    (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
    (2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24),
    (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64),
    (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
)
"""Of groups 1 to 7 by bit. Lists of satellites (bits 14 and 15 of groups 4 and 7) have no fixed
length and are not read."""


class Field(NamedTuple):
    """A field of a binary message."""

    group: int
    """1 to 7."""
    bit: int


class VectorNavFraming(Framing):
    """Binary and ASCII messages, mixed as the instrument sends them."""

    longest = LONGEST
    padding = b"\r\n"

    def find(self, buffer: bytes, at: int) -> int:
        found = MARKS.search(buffer, at)
        return found.start() if found else -1

    def length(self, buffer: bytes, at: int) -> int:
        if buffer[at] == SYNC:
            return _binary_length(buffer, at)
        ends = [buffer.find(end, at + 1, at + LONGEST_LINE) for end in (b"\r", b"\n")]
        if max(ends) > 0:
            return min(end for end in ends if end > 0) + 1 - at
        return NO_PACKET if len(buffer) - at >= LONGEST_LINE else INCOMPLETE

    def intact(self, packet: bytes) -> bool:
        if packet[0] == SYNC:
            return binascii.crc_hqx(packet[1:], 0) == 0
        match = LINE.fullmatch(packet)
        if match is None:
            return False
        body, digits = match.groups()
        right = reduce(xor, body, 0) if len(digits) == 2 else binascii.crc_hqx(body, 0)
        return int(digits, 16) == right


def fields_of(packet: bytes) -> dict[Field, bytes]:
    """The fields of an intact binary message."""
    masks, at = _masks(packet, 0)
    found = {}
    for group, mask in masks.items():
        for bit, size in enumerate(FIELD_BYTES[group - 1]):
            if mask >> bit & 1:
                found[Field(group, bit)] = packet[at : at + size]
                at += size
    return found


def line_of(packet: bytes) -> tuple[str, list[str]]:
    """Kind and fields of an intact ASCII message; a counter or status that is appended is left."""
    match = LINE.fullmatch(packet)
    assert match is not None
    kind, *fields = match.group(1).decode("ascii").split(",")
    return kind, fields


def _binary_length(buffer: bytes, at: int) -> int:
    if len(buffer) - at < 2:
        return INCOMPLETE
    groups = buffer[at + 1]
    header = 2 + 2 * groups.bit_count()
    if groups == 0 or groups & EXTENDED_GROUPS:
        return NO_PACKET
    if len(buffer) - at < header:
        return INCOMPLETE
    masks, _ = _masks(buffer, at)
    size = 0
    for group, mask in masks.items():
        sizes = FIELD_BYTES[group - 1]
        if mask == 0 or mask & EXTENDED_FIELDS or mask >> len(sizes):
            return NO_PACKET
        size += sum(each for bit, each in enumerate(sizes) if mask >> bit & 1)
    return header + size + CRC


def _masks(buffer: bytes, at: int) -> tuple[dict[int, int], int]:
    """The fields of each group that is there, and where the values begin."""
    groups = [number for number in range(1, 8) if buffer[at + 1] >> (number - 1) & 1]
    masks = struct.unpack_from(f"<{len(groups)}H", buffer, at + 2)
    return dict(zip(groups, masks, strict=True)), at + 2 + 2 * len(groups)


# --------------------------------------------------------------------------------------------------
# The decoder.

STARTUP = (Field(1, 0), Field(2, 0))
"""Nanoseconds since it was switched on."""
QUATERNION, ANGLES = (Field(1, 4), Field(5, 2)), (Field(1, 3), Field(5, 1))
"""x, y, z, w; yaw, pitch, roll in degrees."""
RATE, FORCE = (Field(1, 5), Field(3, 10), Field(3, 3)), (Field(1, 8), Field(3, 9), Field(3, 2))
"""Compensated by the filter, or as the calibrated sensor measured it."""
SENSORS = Field(1, 9)
"""The latter two in one field."""
GNSS_FIX, GNSS_PLACE, GNSS_SIGMA = Field(4, 4), Field(4, 5), Field(4, 9)
"""Kind of fix; latitude, longitude, height; 1 sigma to north, east, down in m."""
PLACE, SIGMA = (Field(6, 1), Field(1, 6)), Field(6, 9)
"""The same of the filter, with one sigma."""
STATUS = (Field(6, 0), Field(1, 12))
"""Of the filter; on a VN-100, which states no place, the second is something else."""
UTC, UTC_STATUS = Field(2, 6), Field(2, 9)
"""Years since 2000, month, day, hour, minute, second, ms; and whether they are right."""
UTC_KNOWN = 0b111
"""Time, date and the leap seconds are."""
FIX_3D = 3
"""The least fix that places a vehicle; differential and RTK fixes are above."""
MODE, TRACKING, HAS_FIX = 0b11, 2, 0b100
"""Of the filter's status: it tracks within its specification, and with a receiver's fix."""

Samples: TypeAlias = list[TelemetrySample]
Fields: TypeAlias = Mapping[Field, bytes]
Numbers: TypeAlias = tuple[float, ...]


class VectorNavDecoder(PacketDecoder):
    """Attitude, angular rate, specific force, position and UTC of each message that holds them."""

    def __init__(self, name: str, config: VectorNavConfig) -> None:
        super().__init__(name, VectorNavFraming())
        self.clock: DeviceClock = DeviceClock(name)
        self._fixes = Fixes(config)
        self._lines: dict[str, Callable[[list[str], int, str], Samples]] = {
            "VNYPR": lambda said, at, source: _angles(_numbers(said[:3]), at, source),
            "VNQTN": lambda said, at, source: _quaternion(_numbers(said[:4]), at, at, source),
            "VNYMR": lambda said, at, source: _motion(said[:3], said[6:12], at, source),
            "VNACC": lambda said, at, source: [Acceleration(at, at, source, _vector(said[:3]))],
            "VNGYR": lambda said, at, source: [AngularRate(at, at, source, _vector(said[:3]))],
            "VNIMU": lambda said, at, source: _motion([], said[3:9], at, source),
            "VNISL": lambda said, at, source: _motion(said[:3], said[9:15], at, source),
            "VNINS": self._read_filter,
        }

    def decode(self, packet: bytes, arrival_ns: int) -> Samples:
        if packet[0] != SYNC:
            kind, said = line_of(packet)
            convert = self._lines.get(kind)
            return [] if convert is None else convert(said, arrival_ns, self.source(kind))
        fields = fields_of(packet)
        startup = _first(fields, STARTUP)
        t_ns = arrival_ns
        if startup is not None:
            t_ns = self.clock.stamp(int.from_bytes(startup, "little"), arrival_ns)
        stamp = (t_ns, arrival_ns, self.source("binary"))
        return [*_inertial(fields, *stamp), *self._place(fields, *stamp), *_utc(fields, *stamp)]

    def _place(self, fields: Fields, t_ns: int, arrival_ns: int, source: str) -> Samples:
        """The receiver's fix, else the filter's while it has one."""
        if GNSS_PLACE in fields:
            if GNSS_FIX in fields and fields[GNSS_FIX][0] < FIX_3D:
                return []
            latitude, longitude, _ = struct.unpack("<3d", fields[GNSS_PLACE])
            sigma_m = sigma_of(None)
            if GNSS_SIGMA in fields:
                north, east, _ = struct.unpack("<3f", fields[GNSS_SIGMA])
                sigma_m = math.sqrt((north**2 + east**2) / 2.0)
            return self._fixes.fix(t_ns, arrival_ns, source, latitude, longitude, sigma_m)
        place, status = _first(fields, PLACE), _first(fields, STATUS)
        if place is None or (status is not None and not _has_fix(*struct.unpack("<H", status))):
            return []
        latitude, longitude, _ = struct.unpack("<3d", place)
        stated = struct.unpack("<f", fields[SIGMA])[0] if SIGMA in fields else 0.0
        sigma_m = stated or sigma_of(None)
        return self._fixes.fix(t_ns, arrival_ns, source, latitude, longitude, sigma_m)

    def _read_filter(self, said: list[str], t_ns: int, source: str) -> Samples:
        """VNINS: seconds, week, status; yaw, pitch, roll; latitude, longitude, height; velocity;
        sigmas of attitude, position, velocity."""
        samples = _angles(_numbers(said[3:6]), t_ns, source)
        if _has_fix(int(said[2], 16)):
            latitude, longitude = _numbers(said[6:8])
            sigma_m = float(said[13]) or sigma_of(None)
            samples += self._fixes.fix(t_ns, t_ns, source, latitude, longitude, sigma_m)
        return samples


def _inertial(fields: Fields, t_ns: int, arrival_ns: int, source: str) -> Samples:
    samples: Samples = []
    if (q := _first(fields, QUATERNION)) is not None:
        samples += _quaternion(struct.unpack("<4f", q), t_ns, arrival_ns, source)
    elif (angles := _first(fields, ANGLES)) is not None:
        yaw, pitch, roll = (math.radians(each) for each in struct.unpack("<3f", angles))
        samples.append(Attitude(t_ns, arrival_ns, source, from_euler(roll, pitch, yaw)))
    sensors = fields.get(SENSORS, b"")
    if force := _first(fields, FORCE) or sensors[:12]:
        x, y, z = struct.unpack("<3f", force)
        samples.append(Acceleration(t_ns, arrival_ns, source, (x, y, z)))
    if rate := _first(fields, RATE) or sensors[12:]:
        x, y, z = struct.unpack("<3f", rate)
        samples.append(AngularRate(t_ns, arrival_ns, source, (x, y, z)))
    return samples


def _utc(fields: Fields, t_ns: int, arrival_ns: int, source: str) -> Samples:
    """Only where the message says that it is known: a clock that was never set counts from 0."""
    if UTC not in fields or fields.get(UTC_STATUS, b"\0")[0] & UTC_KNOWN != UTC_KNOWN:
        return []
    year, month, day, hour, minute, second, ms = struct.unpack("<b5BH", fields[UTC])
    moment = datetime(2000 + year, month, day, hour, minute, tzinfo=timezone.utc)
    utc_ns = (int(moment.timestamp()) + second) * 10**9 + ms * 10**6
    return [UtcTime(t_ns, arrival_ns, source, utc_ns)]


def _quaternion(xyzw: Numbers, t_ns: int, arrival_ns: int, source: str) -> Samples:
    x, y, z, w = xyzw
    return [Attitude(t_ns, arrival_ns, source, normalise((w, x, y, z)))]


def _angles(degrees: Numbers, t_ns: int, source: str) -> Samples:
    yaw, pitch, roll = (math.radians(each) for each in degrees)
    return [Attitude(t_ns, t_ns, source, from_euler(roll, pitch, yaw))]


def _motion(angles: list[str], sensors: list[str], t_ns: int, source: str) -> Samples:
    """Yaw, pitch, roll where the message has them; acceleration and angular rate."""
    samples = _angles(_numbers(angles), t_ns, source) if angles else []
    samples.append(Acceleration(t_ns, t_ns, source, _vector(sensors[:3])))
    samples.append(AngularRate(t_ns, t_ns, source, _vector(sensors[3:])))
    return samples


def _has_fix(status: int) -> bool:
    return status & MODE == TRACKING and bool(status & HAS_FIX)


def _first(fields: Fields, wanted: tuple[Field, ...]) -> bytes | None:
    return next((fields[each] for each in wanted if each in fields), None)


def _numbers(said: list[str]) -> Numbers:
    return tuple(map(float, said))


def _vector(said: list[str]) -> tuple[float, float, float]:
    x, y, z = map(float, said)
    return (x, y, z)
