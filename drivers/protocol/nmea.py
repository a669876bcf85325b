"""Echo sounders, compasses, AHRS and receivers that speak NMEA 0183.

They send no time of measurement, so ``t_ns`` is the arrival.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable
from datetime import datetime, timezone
from functools import reduce
from operator import xor
from typing import NamedTuple, TypeAlias

from aquaflow.config.telemetry import NmeaConfig
from aquaflow.drivers.link import about
from aquaflow.drivers.protocol.packets import LineFraming, PacketDecoder
from aquaflow.drivers.samples import Fixes, PartialMotion, sigma_of
from aquaflow.types import Altitude, Depth, TelemetrySample, UtcTime

# --------------------------------------------------------------------------------------------------
# PSIMSSB: what an acoustic system of Kongsberg's HiPAP family, and others that speak like it,
# measure of a transponder.
#
# The sentence has several kinds of coordinates. Only latitude and longitude place the vehicle by
# themselves: what is relative to the ship needs the ship's own fix and heading of the same moment,
# and UTM coordinates lack their zone. The depth is not used; a pressure sensor knows it better.

RADIANS = "R"
"""Coordinates: latitude and longitude, rad. Others are C Cartesian, P polar, U UTM."""
PREDICTED = "P"
"""Not measured (M), nor filtered (F)."""


class NmeaAcoustic:
    """Fixes of the transponder on one link; the config's ``position_sigma_m`` replaces theirs."""

    def __init__(self, name: str, config: NmeaConfig) -> None:
        self._name = name
        self._fixes = Fixes(config)
        self._said_relative = False

    def fix(self, fields: list[str], t_ns: int, source: str) -> list[TelemetrySample]:
        """Time, transponder, A or V, error, coordinates, orientation, filter, x, y, depth, expected
        accuracy, ..."""
        if fields[2] != "A" or fields[6] == PREDICTED:
            return []
        if fields[4] != RADIANS:
            self._say_relative(fields[4])
            return []
        accuracy_m = number(fields[10]) if fields[10] else 0.0
        latitude_deg, longitude_deg = (math.degrees(number(field)) for field in fields[7:9])
        sigma_m = accuracy_m or sigma_of(None)
        return self._fixes.fix(t_ns, t_ns, source, latitude_deg, longitude_deg, sigma_m)

    def _say_relative(self, coordinates: str) -> None:
        if not self._said_relative:
            self._said_relative = True
            log.warning(
                "%s: PSIMSSB with coordinates '%s' does not place the vehicle on the earth; let "
                "the acoustic system send radians (R), or GGA",
                self._name, coordinates, extra=about(self._name, "unused"),
            )  # fmt: skip


log = logging.getLogger(__name__)

KNOT_M_S = 1852.0 / 3600.0
"""m/s; a nautical mile of 1852 m in an hour."""
FOOT_M, FATHOM_M = 0.3048, 1.8288
"""International foot, and six of them."""

Fields = list[str]
Convert: TypeAlias = Callable[[Fields, int, str], list[TelemetrySample]]


class NmeaDecoder(PacketDecoder):
    """DBT DBS DBK DPT, HDT THS HDG HDM, ROT, VBW, XDR, PRDID, PASHR, GGA RMC GST ZDA, PSIMSSB;
    other sentences are counted."""

    def __init__(self, name: str, config: NmeaConfig) -> None:
        super().__init__(name, framing(config.require_checksum))
        self._config = config
        self._motion = PartialMotion(config.assume)
        self._said_magnetic = False
        gnss, acoustic = NmeaGnss(config), NmeaAcoustic(name, config)
        self._sentences: dict[str, Convert] = {
            "DBT": self._below,
            "DBS": self._below,
            "DBK": self._below,
            "DPT": self._below,
            "HDT": self._true_heading,
            "THS": self._heading_with_status,
            "HDG": self._magnetic_heading,
            "HDM": self._compass_heading,
            "ROT": self._rate_of_turn,
            "VBW": self._ground_speed,
            "XDR": self._transducers,
            "PRDID": self._rdi_attitude,
            "PASHR": self._ashtech_attitude,
            "GGA": self._of_gnss(gnss.gga),
            "RMC": self._of_gnss(gnss.rmc),
            "GST": self._of_gnss(gnss.gst),
            "ZDA": self._of_gnss(gnss.zda),
            "PSIMSSB": self._of_gnss(acoustic.fix),
        }

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        sentence = parse(packet)
        convert = self._sentences.get(sentence.kind)
        if convert is None:
            return []
        return convert(sentence.fields, arrival_ns, sentence.kind)

    def _of_gnss(self, convert: Convert) -> Convert:
        return lambda fields, t_ns, kind: convert(fields, t_ns, self.source(kind))

    def _below(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        metres = number(fields[0]) if kind == "DPT" else _in_metres(fields)
        if kind in self._config.depth_sentences:
            return [Depth(t_ns, t_ns, self.source(kind), metres)]
        return [Altitude(t_ns, t_ns, self.source(kind), metres)]

    def _true_heading(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        return self._motion.heading(t_ns, self.source(kind), math.radians(number(fields[0])))

    def _magnetic_heading(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        """HDG: sensor heading, deviation and its E or W, variation and its E or W."""
        degrees = number(fields[0]) + _eastward(fields[1], fields[2])
        degrees += _eastward(fields[3], fields[4]) if fields[3] else self._variation_deg(kind)
        return self._motion.heading(t_ns, self.source(kind), math.radians(degrees))

    def _compass_heading(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        """HDM: magnetic heading, M."""
        degrees = number(fields[0]) + self._variation_deg(kind)
        return self._motion.heading(t_ns, self.source(kind), math.radians(degrees))

    def _variation_deg(self, kind: str) -> float:
        """What a heading that states no variation lacks; a warning where nothing says it."""
        if self._config.variation_deg is None and not self._said_magnetic:
            self._said_magnetic = True
            log.warning(
                "%s: %s states no variation, so its heading is magnetic; set variation_deg of this "
                "device, or fusion.declination",
                self.name, kind, extra=about(self.name, "unused"),
            )  # fmt: skip
        return self._config.variation_deg or 0.0

    def _heading_with_status(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        """THS: true heading, and A where it is measured; not: estimated, typed in, simulated."""
        if fields[1] != "A":
            raise ValueError("the gyro calls its heading something else than measured")
        return self._true_heading(fields, t_ns, kind)

    def _rate_of_turn(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        """ROT: degrees per minute, negative to port; A: valid."""
        if fields[1] != "A":
            raise ValueError("the gyro calls its rate of turn invalid")
        rate_rad_s = math.radians(number(fields[0])) / 60.0
        return self._motion.turn(t_ns, self.source(kind), rate_rad_s)

    def _ground_speed(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        """VBW: through water ahead, sideways, status; over ground ahead, sideways, status."""
        if fields[5] != "A":
            raise ValueError("the log calls its speed over ground invalid")
        forward, right = (number(field) * KNOT_M_S for field in fields[3:5])
        return self._motion.speed(t_ns, self.source(kind), forward, right)

    def _transducers(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        """XDR: type, value, unit, name again and again; roll and pitch complete the heading."""
        quads = zip(fields[0::4], fields[1::4], fields[2::4], fields[3::4], strict=False)
        degrees = {name.upper()[:4]: value for _, value, unit, name in quads if unit == "D"}
        pitch = degrees.get("PTCH", degrees.get("PITC"))
        if pitch is not None and "ROLL" in degrees:
            roll_rad, pitch_rad = (math.radians(number(v)) for v in (degrees["ROLL"], pitch))
            self._motion.tilt(t_ns, roll_rad, pitch_rad)
        return []

    def _rdi_attitude(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        """PRDID: pitch, bow up positive; roll, port side up positive; heading; degrees."""
        pitch, roll, yaw = (math.radians(number(field)) for field in fields[:3])
        return self._motion.attitude(t_ns, self.source(kind), roll, pitch, yaw)

    def _ashtech_attitude(self, fields: Fields, t_ns: int, kind: str) -> list[TelemetrySample]:
        """PASHR: time, heading, T, roll, pitch, heave, three accuracies, quality."""
        yaw, roll, pitch = (math.radians(number(fields[k])) for k in (1, 3, 4))
        return self._motion.attitude(t_ns, self.source(kind), roll, pitch, yaw)


def _in_metres(fields: Fields) -> float:
    """``feet,f,metres,M,fathoms,F`` of which some may be empty."""
    units = {"f": FOOT_M, "M": 1.0, "F": FATHOM_M}
    by_unit = {unit: value for value, unit in zip(fields[::2], fields[1::2], strict=False) if value}
    for unit in ("M", "f", "F"):
        if unit in by_unit:
            return number(by_unit[unit]) * units[unit]
    raise ValueError("no depth in any unit")


def _eastward(value: str, direction: str) -> float:
    if not value:
        return 0.0
    return number(value) * {"E": 1.0, "W": -1.0}[direction]


# --------------------------------------------------------------------------------------------------
# NMEA 0183 sentences of receivers and acoustic positioning systems: GGA, RMC, GST, ZDA.
#
# They state the UTC of the fix or of the second, and are stamped at their arrival; what a receiver
# needs to compute and send them is ``position_lag_s``.

GGA_FIXES = frozenset({1, 2, 3, 4, 5})
"""Qualities of GGA: autonomous, differential, PPS, RTK fixed and float; not: none (0), dead
reckoning (6), typed in (7), simulated (8)."""
RMC_FIXES = frozenset("ADPRF")
"""Modes of RMC likewise; absent before NMEA 2.3."""
ACCURACY_LIFE_NS = 5_000_000_000
"""A GST older than this is not used; receivers that send it do so with every fix, or nearly."""
GGA_LIFE_NS = 5_000_000_000
"""RMC repeats the fix of GGA without its accuracy, and is used where there was no GGA for so
long."""
CENTURY = 2000
"""RMC's year has two digits."""

Samples = list[TelemetrySample]


class NmeaGnss:
    """Fixes and UTC of one link."""

    def __init__(self, config: NmeaConfig) -> None:
        self._fixes = Fixes(config)
        self._accuracy: tuple[int, float] | None = None
        self._gga_ns: int | None = None

    def gga(self, fields: Fields, t_ns: int, source: str) -> Samples:
        """Time, latitude, N or S, longitude, E or W, quality, satellites, HDOP, ..."""
        if int(fields[5]) not in GGA_FIXES:
            return []
        self._gga_ns = t_ns
        hdop = number(fields[7]) if fields[7] else None
        return self._fix(fields[1:5], t_ns, source, hdop)

    def rmc(self, fields: Fields, t_ns: int, source: str) -> Samples:
        """Time, A or V, latitude, N or S, longitude, E or W, speed, course, day, ..., mode."""
        if fields[1] != "A" or (len(fields) > 11 and fields[11] not in RMC_FIXES):
            return []
        day, month, year = (int(fields[8][at : at + 2]) for at in (0, 2, 4))
        utc_ns = _utc_ns(CENTURY + year, month, day, fields[0])
        found: Samples = [UtcTime(self._fixes.date(t_ns), t_ns, source, utc_ns)]
        if self._gga_ns is None or t_ns - self._gga_ns > GGA_LIFE_NS:
            found += self._fix(fields[2:6], t_ns, source, None)
        return found

    def gst(self, fields: Fields, t_ns: int, source: str) -> Samples:
        """1 sigma of the next fixes: ..., of latitude, of longitude, of height; m."""
        self._accuracy = None
        if fields[5] and fields[6]:
            mean_square = (number(fields[5]) ** 2 + number(fields[6]) ** 2) / 2.0
            self._accuracy = (t_ns, mean_square**0.5)
        return []

    def zda(self, fields: Fields, t_ns: int, source: str) -> Samples:
        """Time, day, month, year, zone; all are empty until the receiver knows the time."""
        if not all(fields[:4]):
            return []
        day, month, year = map(int, fields[1:4])
        return [UtcTime(t_ns, t_ns, source, _utc_ns(year, month, day, fields[0]))]

    def _fix(self, place: Fields, t_ns: int, source: str, hdop: float | None) -> Samples:
        sigma_m = sigma_of(hdop)
        if self._accuracy is not None and t_ns - self._accuracy[0] <= ACCURACY_LIFE_NS:
            sigma_m = self._accuracy[1]
        latitude_deg = _degrees(place[0], {"N": 1.0, "S": -1.0}[place[1]])
        longitude_deg = _degrees(place[2], {"E": 1.0, "W": -1.0}[place[3]])
        return self._fixes.fix(t_ns, t_ns, source, latitude_deg, longitude_deg, sigma_m)


def _degrees(field: str, sign: float) -> float:
    """``ddmm.mmmm`` or ``dddmm.mmmm``."""
    degrees, minutes = divmod(number(field), 100.0)
    if not minutes < 60.0:
        raise ValueError("an angle has less than 60 minutes")
    return sign * (degrees + minutes / 60.0)


def _utc_ns(year: int, month: int, day: int, clock: str) -> int:
    """``clock`` is ``hhmmss`` with or without a fraction."""
    minute = datetime(year, month, day, int(clock[:2]), int(clock[2:4]), tzinfo=timezone.utc)
    second = number(clock[4:])
    if not 0.0 <= second < 61.0:
        raise ValueError("a minute has 60 seconds, rarely 61")
    return int(minute.timestamp()) * 1_000_000_000 + round(second * 1e9)


# --------------------------------------------------------------------------------------------------
# NMEA 0183 sentences: ``$IIHDT,271.3,T*2C`` and a line end.
#
# Own framing, because a shared line brings half sentences; pynmea2 adds only names to what
# :mod:`aquaflow.drivers.protocol.nmea` reads.

LONGEST = 256
"""Bytes. The standard has 82; proprietary sentences are longer."""
BODY = re.compile(rb"[$!]([\x20-\x7e]*?)(?:\*([0-9A-Fa-f]{2}))?[ \t]*[\r\n]")
"""A sentence: what the checksum covers, and the two digits of it, if there are any."""


class Sentence(NamedTuple):
    """``talker`` is empty for proprietary sentences, whose ``kind`` starts with P."""

    talker: str
    kind: str
    fields: list[str]


def checksum(body: bytes) -> int:
    """Of what stands between the mark and the star."""
    return reduce(xor, body, 0)


def framing(require_checksum: bool) -> LineFraming:
    """Finds sentences in a stream; ``require_checksum`` drops those that carry none."""

    def intact(packet: bytes) -> bool:
        match = BODY.fullmatch(packet)
        if match is None:
            return False
        body, sent = match.groups()
        if sent is None:
            return not require_checksum
        return checksum(body) == int(sent, 16)

    return LineFraming(b"$!", LONGEST, intact)


def parse(packet: bytes) -> Sentence:
    """Parse an intact sentence."""
    match = BODY.fullmatch(packet)
    assert match is not None
    address, *fields = match.group(1).decode("ascii").split(",")
    if address.startswith("P"):
        return Sentence("", address, fields)
    return Sentence(address[:-3], address[-3:], fields)


def number(field: str) -> float:
    """ValueError for an empty field, which is how NMEA says 'not available'."""
    return float(field)
