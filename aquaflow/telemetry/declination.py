"""What a compass's north differs from true north: the magnetic declination, unless it is applied.

ArduPilot's vehicles, ArduSub among them, look the declination up and add it to their heading from
the moment that they know where they are (AP_Compass.cpp, ``try_set_initial_location``;
COMPASS_AUTODEC is 1 by default). Without a position of their own they add COMPASS_DEC, which is 0
by default, so that their heading is magnetic (bluerobotics/qgroundcontrol, issue 143).
"""

from __future__ import annotations

from datetime import datetime, timezone

import numpy as np

from aquaflow.config import FusionConfig
from aquaflow.telemetry.telemetry import Telemetry, device_of
from aquaflow.telemetry.utc import fit_utc
from aquaflow.types import Attitude, Position

MODEL_YEARS = (2010.0, 2029.99)
"""Of the World Magnetic Model's coefficients that pygeomag brings; a later dive takes the last ones
(the model changes by some 0.1 degrees a year)."""


def declination_of(telemetry: Telemetry, config: FusionConfig) -> float | None:
    """rad to be added to the compass's heading, positive where magnetic north lies in the east.

    None where it is not known: x of the world then points to magnetic north.
    """
    if config.declination == "none":
        return None
    if config.declination != "auto":
        return float(np.radians(config.declination))
    compasses, places = telemetry.of(Attitude), telemetry.of(Position)
    if not compasses or not places:
        return None
    if device_of(compasses[0].source) in {device_of(each.source) for each in places}:
        return 0.0
    clock = fit_utc(telemetry.utc)
    if clock is None:
        return None
    place = np.median(places[0].values[:, :2], axis=0)
    date = clock.utc_of(round(1e9 * float(places[0].t_s[0])))
    return _by_model(float(place[0]), float(place[1]), date)


def _by_model(latitude_deg: float, longitude_deg: float, date: datetime) -> float | None:
    """rad by the World Magnetic Model; None near a magnetic pole, where it gives none."""
    from pygeomag import GeoMag

    began = datetime(date.year, 1, 1, tzinfo=timezone.utc)
    year = date.year + (date - began).total_seconds() / (365.25 * 86400.0)
    model = GeoMag(base_year=float(np.clip(year, *MODEL_YEARS)))
    field = model.calculate(
        latitude_deg, longitude_deg, 0.0, year, allow_date_outside_lifespan=True
    )
    return None if field.in_blackout_zone else float(np.radians(field.d))
