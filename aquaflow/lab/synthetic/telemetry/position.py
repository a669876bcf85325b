"""Acoustic fixes of the vehicle on the earth, and the time on it."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.earth import latitude_longitude
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.telemetry.series import choose
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise

__all__ = ["position", "utc_time"]

Array: TypeAlias = npt.NDArray[np.float64]


def position(
    t: Array,  # [N] s, at which fixes are stamped
    motion: TrueBodyMotion,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 3] latitude and longitude (degrees, WGS 84) of the body's origin, 1 sigma in m.

    A fix shows where the vehicle was ``position_lag_s`` before its stamp; nan where that is
    before the first picture.
    """
    heard_from = t - noise.position_lag_s
    error = noise.position_sigma_m * rng.standard_normal((len(t), 2))
    stray = noise.position_outlier_sigma_m * rng.standard_normal((len(t), 2))
    outlier = choose(len(t), noise.position_outlier_share, rng)
    place = motion.origin_w(heard_from)[:, :2] + np.where(outlier[:, None], stray, error)
    sigma = np.full((len(t), 1), noise.position_sigma_m)
    found = np.hstack([_on_earth(place, noise), sigma])
    return np.where(heard_from[:, None] < 0.0, np.nan, found)


def utc_time(
    t: Array,  # [N] s
    noise: TelemetryNoise,
) -> npt.NDArray[np.int64]:
    """[N, 1] ns since 1970-01-01 UTC."""
    # Microseconds are exact in a double; its nanoseconds since 1970 are not.
    start_us = round(noise.starts_utc.timestamp() * 1e6)
    return 1000 * start_us + np.round(t * 1e9).astype(np.int64)[:, None]


def _on_earth(
    place: Array,  # [N, 2] m north and east of the origin
    noise: TelemetryNoise,
) -> Array:
    """[N, 2] degrees (WGS 84)."""
    origin = (noise.origin_latitude_deg, noise.origin_longitude_deg)
    at_the_surface = np.column_stack([place, np.zeros(len(place))])
    return np.stack(latitude_longitude(at_the_surface, origin), axis=1)
