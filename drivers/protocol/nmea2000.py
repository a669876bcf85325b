"""Instruments on an NMEA 2000 bus.

Of the position 129025 is read, several times a second, with the accuracy from 129539; where no
129025 comes, the position of 129029, a fast packet. They send no time of measurement, so ``t_ns``
is the arrival.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from aquaflow.config.instruments import Nmea2000Config
from aquaflow.drivers.protocol.dbc import CanFraming, frame_of
from aquaflow.drivers.protocol.packets import PacketDecoder
from aquaflow.drivers.samples import Fixes, PartialMotion, sigma_of
from aquaflow.types import Altitude, TelemetrySample, UtcTime

HEADING, RATE_OF_TURN, ATTITUDE, SPEED, WATER_DEPTH = 127250, 127251, 127257, 128259, 128267
SYSTEM_TIME, POSITION, FIX, DILUTION = 126992, 129025, 129029, 129539
"""Parameter group numbers."""

NOT_AVAILABLE = {
    "H": 0xFFFF, "h": 0x7FFF, "I": 0xFFFF_FFFF, "i": 0x7FFF_FFFF, "q": 0x7FFF_FFFF_FFFF_FFFF,
}  # fmt: skip
"""The largest value of each type, by struct's letter."""
RESERVED = 2
"""The two values below 'not available' mean 'out of range' and 'reserved'."""
TRUE, MAGNETIC = 0, 1
"""References of a heading; the others are 'error' and 'not available'."""
ANGLE_RAD, RATE_RAD_S, SPEED_M_S, DEPTH_M = 1e-4, 3.125e-8, 0.01, 0.01
PLACE_DEG, HDOP, DAY_NS, CLOCK_NS = 1e-7, 0.01, 86_400_000_000_000, 100_000
"""Value of one count of each field."""
FINE_PLACE_DEG = 1e-16
"""Likewise in 129029."""
FIX_METHODS = (1, 2, 3, 4, 5)
"""Methods of 129029: autonomous, differential, precise, RTK; not: none, reckoned, typed in,
simulated."""
POSITION_LIFE_NS = 5_000_000_000
"""129029 places the vehicle where there was no 129025 for so long."""
FIX_MODES = (1, 2)
"""Modes of 129539 with a fix, 2D and 3D; not: 1D (0) and error."""
LOCAL_CRYSTAL = 5
"""Source of 126992 that no satellite or radio sets."""
DILUTION_LIFE_NS = 5_000_000_000
"""The standard has a 129539 every second."""


def group_of(identifier: int) -> int:
    """The parameter group number in a 29 bit identifier."""
    group = identifier >> 8 & 0x3FFFF
    # Below 0xF0 the low byte is the addressee.
    return group & 0x3FF00 if group >> 8 & 0xFF < 0xF0 else group


class Nmea2000Decoder(PacketDecoder):
    """Attitude, heading, rate of turn, speed, altitude, position and UTC."""

    def __init__(self, name: str, config: Nmea2000Config) -> None:
        super().__init__(name, CanFraming())
        self._motion = PartialMotion(config.assume)
        self._fixes = Fixes(config)
        self._fast = FastPackets()
        self._dilution: tuple[int, bool, float | None] | None = None
        self._position_ns: int | None = None
        self._groups: dict[int, Callable[[bytes, int], list[TelemetrySample]]] = {
            HEADING: self._heading,
            RATE_OF_TURN: self._rate_of_turn,
            ATTITUDE: self._attitude,
            SPEED: self._speed,
            WATER_DEPTH: self._depth,
            SYSTEM_TIME: self._utc,
            POSITION: self._position,
            DILUTION: self._accuracy,
            FIX: self._whole_fix,
        }

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        frame = frame_of(packet)
        group = group_of(frame.identifier) if frame.extended else None
        convert = None if group is None else self._groups.get(group)
        if convert is None:
            return []
        data = self._fast.add(frame.identifier, frame.data) if group == FIX else frame.data
        return [] if data is None else convert(data, arrival_ns)

    def _heading(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        yaw = _value("H", data, 1) * ANGLE_RAD
        reference = data[7] & 0b11
        if reference == MAGNETIC:
            yaw += sum(_value_or_zero("h", data, at) * ANGLE_RAD for at in (3, 5))
        elif reference != TRUE:
            raise ValueError("neither a true nor a magnetic heading")
        return self._motion.heading(t_ns, self.source(str(HEADING)), yaw)

    def _rate_of_turn(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        rate_rad_s = _value("i", data, 1) * RATE_RAD_S
        return self._motion.turn(t_ns, self.source(str(RATE_OF_TURN)), rate_rad_s)

    def _attitude(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        pitch, roll = (_value("h", data, at) * ANGLE_RAD for at in (3, 5))
        if _missing("h", data, 1):
            self._motion.tilt(t_ns, roll, pitch)
            return []
        yaw = _value("h", data, 1) * ANGLE_RAD
        return self._motion.attitude(t_ns, self.source(str(ATTITUDE)), roll, pitch, yaw)

    def _speed(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        if _missing("H", data, 3):
            return []  # a paddle wheel: it knows the speed through water only
        forward_m_s = _value("H", data, 3) * SPEED_M_S
        return self._motion.speed(t_ns, self.source(str(SPEED)), forward_m_s, None)

    def _depth(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        """Below the transducer; its offset to the waterline or the keel is the mounting's."""
        metres = _value("I", data, 1) * DEPTH_M
        return [Altitude(t_ns, t_ns, self.source(str(WATER_DEPTH)), metres)]

    def _utc(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        if data[1] & 0xF == LOCAL_CRYSTAL:
            return []
        days, clock = _value("H", data, 2), _value("I", data, 4)
        return [
            UtcTime(t_ns, t_ns, self.source(str(SYSTEM_TIME)), days * DAY_NS + clock * CLOCK_NS)
        ]

    def _accuracy(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        """Bits 3 to 5 of the second byte are the mode that the receiver is in."""
        hdop = None if _missing("h", data, 2) else _value("h", data, 2) * HDOP
        self._dilution = (t_ns, data[1] >> 3 & 0b111 in FIX_MODES, hdop)
        return []

    def _position(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        if _missing("i", data, 0) or _missing("i", data, 4):
            return []  # no fix
        self._position_ns = t_ns
        fixed, hdop = True, None
        if self._dilution is not None and t_ns - self._dilution[0] <= DILUTION_LIFE_NS:
            _, fixed, hdop = self._dilution
        if not fixed:
            return []
        degrees = [_value("i", data, at) * PLACE_DEG for at in (0, 4)]
        source = self.source(str(POSITION))
        return self._fixes.fix(t_ns, t_ns, source, degrees[0], degrees[1], sigma_of(hdop))

    def _whole_fix(self, data: bytes, t_ns: int) -> list[TelemetrySample]:
        """129029: date and time, latitude, longitude, height, and how they were found."""
        if data[31] >> 4 not in FIX_METHODS:
            return []
        source = self.source(str(FIX))
        days, clock = _value("H", data, 1), _value("I", data, 3)
        utc_ns = days * DAY_NS + clock * CLOCK_NS
        found: list[TelemetrySample] = [UtcTime(self._fixes.date(t_ns), t_ns, source, utc_ns)]
        if self._position_ns is not None and t_ns - self._position_ns <= POSITION_LIFE_NS:
            return found
        lat, lon = (_value("q", data, at) * FINE_PLACE_DEG for at in (7, 15))
        hdop = None if _missing("h", data, 34) else _value("h", data, 34) * HDOP
        return found + self._fixes.fix(t_ns, t_ns, source, lat, lon, sigma_of(hdop))


def _missing(code: str, data: bytes, at: int) -> bool:
    value = struct.unpack_from("<" + code, data, at)[0]
    return bool(value >= NOT_AVAILABLE[code] - RESERVED)


def _value(code: str, data: bytes, at: int) -> int:
    if _missing(code, data, at):
        raise ValueError("the instrument calls its value not available")
    return int(struct.unpack_from("<" + code, data, at)[0])


def _value_or_zero(code: str, data: bytes, at: int) -> int:
    return 0 if _missing(code, data, at) else _value(code, data, at)


# --------------------------------------------------------------------------------------------------
# Messages of NMEA 2000 that take several frames of a CAN bus (fast packets).
#
# The first byte of each frame holds the number of the message (3 bits) and of the frame (5 bits);
# the second byte of frame 0 holds the length in bytes.

FRAME_BITS = 5
FIRST_DATA, NEXT_DATA = 2, 1
"""Bytes before the data in frame 0, and in those after it."""
LONGEST = 223
"""Bytes: 6 of frame 0 and 7 of each of 31 more."""


@dataclass
class _Open:
    """A message of which frames are missing."""

    number: int
    length: int
    frames: int
    data: bytearray = field(default_factory=bytearray)


class FastPackets:
    """Puts the messages of each sender together; one that lacks a frame is dropped whole."""

    def __init__(self) -> None:
        self._open: dict[int, _Open] = {}

    def add(self, identifier: int, data: bytes) -> bytes | None:
        """The message that the frame ``data`` completes; ``identifier`` names group and sender.

        Raises:
            ValueError: a frame is missing, or states an impossible length.
        """
        number, frame = data[0] >> FRAME_BITS, data[0] & (1 << FRAME_BITS) - 1
        if frame == 0:
            if not 0 < data[1] <= LONGEST:
                raise ValueError("a fast packet states a length that it cannot have")
            message = _Open(number, data[1], 0)
            part = data[FIRST_DATA:]
        else:
            message = self._open.pop(identifier, _Open(number, 0, 0))
            if message.length == 0 or (message.number, message.frames) != (number, frame):
                raise ValueError("a frame of a fast packet is missing")
            part = data[NEXT_DATA:]
        message.data += part
        message.frames = frame + 1
        if len(message.data) >= message.length:
            return bytes(message.data[: message.length])
        self._open[identifier] = message
        return None
