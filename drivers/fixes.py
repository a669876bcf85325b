"""Fixes on the earth as samples: how old they are, how accurate, and moved by a lever arm."""

from __future__ import annotations

import math
from dataclasses import replace

from aquaflow.config.stage import PositioningConfig
from aquaflow.types import Position, TelemetrySample

UERE_M = 5.1
"""m, 1 sigma of a range to a satellite, single frequency without corrections: B. Parkinson, "GPS
Error Analysis", in Global Positioning System: Theory and Applications I (1996), table 2."""
USUAL_HDOP = 2.0
"""HDOP of a fix that states none; that of the same table."""
ARM_LATITUDE_DEG = 89.9
"""Nearer to a pole a lever arm has no east."""
EQUATOR_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""WGS 84."""


def sigma_of(hdop: float | None) -> float:
    """1 sigma of each horizontal direction, m: HDOP times UERE is that of both together. None or 0:
    not stated."""
    return (hdop or USUAL_HDOP) * UERE_M / math.sqrt(2.0)


class Fixes:
    """The fixes of one device, as its config says.

    Acoustic systems, and the programs between them and a vehicle, send the last fix again while
    there is no newer one, as if it were new. A place that equals the one before to the last digit
    is taken for that; it would hold a moving vehicle back.
    """

    def __init__(self, config: PositioningConfig) -> None:
        self._lag_ns = round(config.position_lag_s * 1e9)
        self._sigma_m = config.position_sigma_m
        self._last: dict[str, tuple[float, float]] = {}

    def date(self, t_ns: int) -> int:
        """When what the device dates ``t_ns`` was measured."""
        return t_ns - self._lag_ns

    def fix(
        self,
        t_ns: int,
        arrival_ns: int,
        source: str,
        latitude_deg: float,
        longitude_deg: float,
        sigma_m: float,
    ) -> list[TelemetrySample]:
        """The sample of a fix that the device dates ``t_ns`` and calls accurate to ``sigma_m``;
        none if it is the fix before."""
        place = (latitude_deg, longitude_deg)
        if self._last.get(source) == place:
            return []
        self._last[source] = place
        t_ns, sigma_m = self.date(t_ns), self._sigma_m or sigma_m
        return [Position(t_ns, arrival_ns, source, *place, sigma_m)]


def move(fix: Position, north_m: float, east_m: float) -> Position:
    """The fix of a point that lies ``north_m`` and ``east_m`` away, a few metres at most."""
    if abs(fix.latitude_deg) > ARM_LATITUDE_DEG:
        return fix
    latitude = math.radians(fix.latitude_deg)
    e2 = FLATTENING * (2.0 - FLATTENING)
    w2 = 1.0 - e2 * math.sin(latitude) ** 2
    transverse_m = EQUATOR_M / math.sqrt(w2)
    meridian_m = transverse_m * (1.0 - e2) / w2
    east = math.degrees(east_m / (transverse_m * math.cos(latitude)))
    longitude_deg = (fix.longitude_deg + east + 180.0) % 360.0 - 180.0
    latitude_deg = fix.latitude_deg + math.degrees(north_m / meridian_m)
    return replace(fix, latitude_deg=latitude_deg, longitude_deg=longitude_deg)
