"""All instruments along one dive: their samples in the order of arrival."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.base.storage.table import csv_text
from aquaflow.geometry.earth import latitude_longitude
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.motion import GRAVITY_M_S2, TrueBodyMotion
from aquaflow.lab.synthetic.streams import Instrument, instrument_stream
from aquaflow.lab.synthetic.telemetry.series import (
    Constants,
    choose,
    random_walk,
    stretches,
    wander,
)
from aquaflow.lab.synthetic.telemetry.sonar import Sonar
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise
from aquaflow.recordings.sample_table import sample_of
from aquaflow.types import TelemetrySample

Array: TypeAlias = npt.NDArray[np.float64]
Measure: TypeAlias = Callable[
    [Array, np.random.Generator], npt.NDArray[np.float64] | npt.NDArray[np.int64]
]
"""Times [N] s and the instrument's stream to values [N, K]; nan where it is silent."""

SOURCE = "synthetic"
"""The instruments' name in samples."""
POSITIONS_HZ = 2.0
"""Of the fixes in a table of their own: the shortest dive that maps, of a second, has some."""


def measure(
    config: SyntheticConfig, motion: TrueBodyMotion, sonar: Sonar, constants: Constants
) -> list[TelemetrySample]:
    """Samples of every instrument between the first picture and the last, by arrival.

    Times are nanoseconds since the first picture.
    """
    last = (config.frames - 1) / config.fps
    samples = [
        sample
        for kind, instrument in _instruments(config, motion, sonar, constants).items()
        for sample in samples_of(kind, *instrument, last, config)
    ]
    return sorted(samples, key=lambda sample: sample.arrival_ns)


def samples_of(
    kind: Instrument, rate_hz: float, values_at: Measure, last_s: float, config: SyntheticConfig
) -> Iterator[TelemetrySample]:
    """Samples of one instrument until ``last_s``, by arrival; none at a rate of 0."""
    if rate_hz == 0.0:
        return
    noise = config.telemetry
    t = np.arange(int(last_s * rate_hz + 1e-9) + 1) / rate_hz
    rng = instrument_stream(config.seed, kind)
    late = rng.exponential(1.0, len(t)) * noise.latency_s
    # One device's messages arrive in the order in which they were sent.
    arrival = np.maximum.accumulate(t + late)
    values = values_at(t, rng)
    heard = np.isfinite(values).all(axis=1) & (t >= noise.starts_late_s)
    for k in np.flatnonzero(heard):
        t_ns, arrival_ns = round(float(t[k]) * 1e9), round(float(arrival[k]) * 1e9)
        yield sample_of(kind, t_ns, arrival_ns, SOURCE, values[k].tolist())


def _instruments(
    config: SyntheticConfig, motion: TrueBodyMotion, sonar: Sonar, constants: Constants
) -> dict[Instrument, tuple[float, Measure]]:
    """Rate (Hz; 0: not aboard) and measurement of each kind."""
    noise = config.telemetry
    known = (motion, constants, noise)
    return {
        "depth": (noise.depth_hz, lambda t, rng: depth(t, *known, rng)),
        "attitude": (noise.attitude_hz, lambda t, rng: attitude(t, *known, rng)),
        "angular_rate": (noise.rate_hz, lambda t, rng: angular_rate(t, *known, rng)),
        "acceleration": (noise.acceleration_hz, lambda t, rng: acceleration(t, *known, rng)),
        "velocity": (noise.dvl_hz, lambda t, rng: velocity(t, *known, rng)),
        "altitude": (noise.altitude_hz, lambda t, rng: altitude(t, motion, sonar, noise, rng)),
        "position": (noise.position_hz, lambda t, rng: position(t, motion, noise, rng)),
        "utc_time": (noise.utc_hz, lambda t, rng: utc_time(t, noise)),
    }


# --------------------------------------------------------------------------------------------------
# The echo sounder that looks down (altimeter).


def altitude(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    sonar: Sonar,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 1] m to the first return within the beam; nan where there is none within its range."""
    path = motion.path
    origin_s = (motion.origin_w(t) - path.t_ws) @ path.R_ws
    R_sb = path.R_ws.T @ motion.R_wb(t)
    beam, longest = np.radians(noise.altitude_beam_deg), noise.altitude_longest_m
    true = sonar.first_return(origin_s, R_sb, beam, longest)
    white = noise.altitude_sigma_m * rng.standard_normal(len(t))
    multipath = choose(len(t), noise.altitude_multipath_share, rng)
    measured = np.where(multipath, 2.0, 1.0) * true + white
    if noise.altitude_resolution_m > 0.0:
        measured = noise.altitude_resolution_m * np.round(measured / noise.altitude_resolution_m)
    heard = (measured >= noise.altitude_shortest_m) & (measured <= longest)
    return np.where(heard, measured, np.nan)[:, None]


# --------------------------------------------------------------------------------------------------
# What an autopilot's inertial sensors measure, and the attitude that it makes of them.


def attitude(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 4] quaternion wxyz of the body in NED.

    The true attitude is turned about the vertical by the compass error, and about the body's own
    axes by the wandering tilt (forward and right only) and white noise.
    """
    in_body = noise.attitude_sigma_deg * rng.standard_normal((len(t), 3))
    in_body[:, :2] += wander(t, noise.tilt_wander_sigma_deg, noise.tilt_wander_s, 2, rng)
    heading = np.zeros((len(t), 3))
    heading[:, 2:] = wander(t, noise.heading_wander_sigma_deg, noise.heading_wander_s, 1, rng)
    heading[:, 2] += constants.heading_offset_deg
    measured = (
        Rotation.from_rotvec(heading, degrees=True)
        * Rotation.from_matrix(motion.R_wb(t))
        * Rotation.from_rotvec(in_body, degrees=True)
    )
    return np.asarray(np.roll(measured.as_quat(canonical=True), 1, axis=1))


def angular_rate(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 3] rad/s, body frame."""
    white = noise.rate_sigma_rad_s * rng.standard_normal((len(t), 3))
    bias = constants.rate_bias_rad_s + random_walk(t, noise.rate_bias_walk, 3, rng)
    return np.asarray(motion.rate_b(t) + bias + white)


def acceleration(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 3] specific force, m/s^2, body frame."""
    white = noise.acceleration_sigma_m_s2 * rng.standard_normal((len(t), 3))
    return np.asarray(motion.force_b(t) + constants.acceleration_bias_m_s2 + white)


# --------------------------------------------------------------------------------------------------
# Acoustic fixes of the vehicle on the earth, and the time on it.


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


def write_positions(path: Path, config: SyntheticConfig, motion: TrueBodyMotion) -> None:
    """The fixes as a plain table (aquaflow/recordings/csv_telemetry.py), ``POSITIONS_HZ`` a second
    unless ``position_hz`` says otherwise."""
    noise, last = config.telemetry, (config.frames - 1) / config.fps
    rate_hz = noise.position_hz or POSITIONS_HZ
    t = np.arange(int(last * rate_hz + 1e-9) + 1) / rate_hz
    fixes = position(t, motion, noise, instrument_stream(config.seed, "position"))
    lines = [("t_s", "latitude_deg", "longitude_deg", "sigma_m")]
    for t_s, (latitude, longitude, sigma) in zip(t, fixes, strict=True):
        if np.isfinite(latitude):
            lines.append((f"{t_s:.9f}", f"{latitude:.9f}", f"{longitude:.9f}", f"{sigma:g}"))
    path.write_text(csv_text(lines), encoding="utf-8")


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


# --------------------------------------------------------------------------------------------------
# The Doppler velocity log (DVL).


def velocity(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 4] m/s over ground in the body's axes, and the figure of merit; nan where it is silent.

    A driver turned the samples into the body by the stated mounting, and moved them to its
    origin; the mounting's error is what remains.
    """
    sigma = noise.dvl_sigma_m_s
    true_d = (1.0 + constants.dvl_scale) * motion.velocity_b(t) @ motion.mountings.R_bd
    measured = true_d + sigma * rng.standard_normal((len(t), 3))
    merit = sigma * np.exp(noise.dvl_merit_spread * rng.standard_normal((len(t), 1)))
    silent = choose(len(t), noise.dvl_dropout_share, rng)
    silent |= stretches(t, noise.dvl_lock_losses_per_min, noise.dvl_lock_loss_s, rng)
    return np.where(silent[:, None], np.nan, np.hstack([measured, merit]))


# --------------------------------------------------------------------------------------------------
# The depth cell, and what moves the surface above it.
#
# World z is 0 at the surface of the first picture, between the waves.


def depth(
    t: Array,  # [N] s
    motion: TrueBodyMotion,
    constants: Constants,
    noise: TelemetryNoise,
    rng: np.random.Generator,
) -> Array:
    """[N, 1] m below the surface, as the pressure has it."""
    true = motion.origin_w(t)[:, 2]
    measured = true + constants.depth_offset_m + tide(t, constants, noise)
    measured += wave(t, true, constants, noise)
    measured += noise.depth_sigma_m * rng.standard_normal(len(t))
    if noise.depth_resolution_m > 0.0:
        measured = noise.depth_resolution_m * np.round(measured / noise.depth_resolution_m)
    return np.asarray(measured)[:, None]


def tide(
    t: Array,  # [N] s
    constants: Constants,
    noise: TelemetryNoise,
) -> Array:
    """[N] m by which the water has risen since the first picture."""
    phase = 2.0 * math.pi * t / noise.tide_period_s + constants.tide_phase_rad
    return noise.tide_amplitude_m * (np.cos(phase) - math.cos(constants.tide_phase_rad))


def wave(
    t: Array,  # [N] s
    depth_m: Array,  # [N] m
    constants: Constants,
    noise: TelemetryNoise,
) -> Array:
    """[N] m of water that a regular wave adds to the pressure at a depth.

    Linear theory of deep water: the pressure falls off by exp(-k depth) with k = omega^2 / g.
    """
    omega = 2.0 * math.pi / noise.wave_period_s
    felt = np.exp(-(omega**2) / GRAVITY_M_S2 * np.maximum(depth_m, 0.0))
    phase = omega * t + constants.wave_phase_rad
    return np.asarray(0.5 * noise.wave_height_m * felt * np.cos(phase))
