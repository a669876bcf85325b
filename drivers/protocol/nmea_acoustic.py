"""PSIMSSB: what an acoustic system of Kongsberg's HiPAP family, and others that speak like it,
measure of a transponder.

The sentence has several kinds of coordinates. Only latitude and longitude place the vehicle by
themselves: what is relative to the ship needs the ship's own fix and heading of the same moment,
and UTM coordinates lack their zone. The depth is not used; a pressure sensor knows it better.
"""

from __future__ import annotations

import logging
import math

from aquaflow.config.telemetry import NmeaConfig
from aquaflow.drivers.events import about
from aquaflow.drivers.fixes import Fixes, sigma_of
from aquaflow.drivers.protocol.nmea_sentence import number
from aquaflow.types import TelemetrySample

log = logging.getLogger(__name__)

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
