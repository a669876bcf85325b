"""NMEA 0183 sentences of receivers and acoustic positioning systems: GGA, RMC, GST, ZDA.

They state the UTC of the fix or of the second, and are stamped at their arrival; what a receiver
needs to compute and send them is ``position_lag_s``.
"""

from __future__ import annotations

from datetime import datetime, timezone

from aquaflow.config.telemetry import NmeaConfig
from aquaflow.drivers.fixes import Fixes, sigma_of
from aquaflow.drivers.protocol.nmea_sentence import number
from aquaflow.types import TelemetrySample, UtcTime

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

Fields = list[str]
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
