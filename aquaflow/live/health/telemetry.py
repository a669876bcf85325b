"""What every source of telemetry measures now, and what is known of the map's metric frame."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timezone
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.types import KIND_OF, VALUES, Attitude, Position, TelemetrySample, UtcTime

UNITS = {
    "depth": "m",
    "attitude": "deg roll, pitch, heading",
    "angular_rate": "rad/s",
    "acceleration": "m/s^2",
    "velocity": "m/s",
    "altitude": "m",
    "lights": "of 1",
    "position": "deg latitude, longitude",
    "utc_time": "UTC",
}
"""Unit of the value of each kind of sample."""
DIGITS, PLACE_DIGITS = 3, 7
"""Decimals shown; a degree of latitude has 111 km."""


def newest_values(
    latest: Iterable[tuple[TelemetrySample, float]],
) -> dict[str, dict[str, dict[str, Any]]]:
    """By source and kind: ``value`` (a number, a list or a text), ``unit`` and ``age_s``.

    ``latest``: the newest sample of each source and kind, and the seconds since it came.
    """
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for sample, age_s in sorted(latest, key=lambda each: each[0].source):
        kind = KIND_OF[type(sample)]
        said = {"value": _value(sample), "unit": UNITS[kind], "age_s": round(age_s, 1)}
        found.setdefault(sample.source, {})[kind] = said
    return found


def _value(sample: TelemetrySample) -> float | list[float] | str:
    if isinstance(sample, UtcTime):
        moment = datetime.fromtimestamp(sample.utc_ns * 1e-9, timezone.utc)
        return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if isinstance(sample, Attitude):
        R = Rotation.from_quat(np.roll(sample.wxyz, -1))
        yaw, pitch, roll = R.as_euler("ZYX", degrees=True)
        return [round(float(angle), DIGITS) for angle in (roll, pitch, yaw % 360.0)]
    if isinstance(sample, Position):
        return [round(each, PLACE_DIGITS) for each in (sample.latitude_deg, sample.longitude_deg)]
    value = getattr(sample, VALUES[type(sample)][0])
    if isinstance(value, tuple):
        return [round(each, DIGITS) for each in value]
    return round(float(value), DIGITS)


def metric_frame_numbers(frame: WorldFrame) -> dict[str, Any]:
    """Whether scale, gravity and north are known, how well, and why sources are not used."""
    return {
        "metric": frame.metric,
        "metres_per_map_unit": round(frame.T_nm.scale, 5) if frame.metric else None,
        "scale_sigma": round(frame.scale_sigma, 5) if frame.metric else None,
        "scale_source": frame.scale_source,
        "clock_offset_s": round(frame.clock_offset_s, DIGITS),
        "level": frame.level,
        "gravity_sigma_deg": (
            round(float(np.degrees(frame.tilt_sigma_rad)), DIGITS) if frame.level else None
        ),
        "north": frame.north,
        "sources": {
            f"{source.source} {source.kind}": {
                "used": source.used, "rejected": source.rejected, "reason": source.reason,
            }
            for source in frame.sources
        },
    }  # fmt: skip
