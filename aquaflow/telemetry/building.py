"""A sub-map's telemetry as the factors of a problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.alignment import north_east
from aquaflow.telemetry import start as rough
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.directions import orient
from aquaflow.telemetry.factors.altitude import AltitudeFactor
from aquaflow.telemetry.factors.depth import DepthFactor
from aquaflow.telemetry.factors.factor import Factor
from aquaflow.telemetry.factors.length import LengthFactor
from aquaflow.telemetry.factors.position import PlaceFactor, PositionFactor
from aquaflow.telemetry.factors.velocity import VelocityFactor
from aquaflow.telemetry.problem import ANY_TURN, OPEN_M, Carried, TelemetryProblem
from aquaflow.telemetry.sources import LEAST_SAMPLES, UsableSeries
from aquaflow.telemetry.state import LAG, SHIFT, TURN
from aquaflow.telemetry.telemetry import Telemetry, device_of
from aquaflow.telemetry.utc import fit_utc
from aquaflow.telemetry.world_frame import Origin, SourceReport
from aquaflow.types import Attitude, Position

Array = npt.NDArray[np.float64]


def problem_of(
    telemetry: Telemetry,
    path: CameraPath,
    config: FusionConfig,
    mounting: MountingConfig | None,
    points: Callable[[], Array],
    carried: Carried | None,
    extra: Sequence[Factor],
    rejected: Mapping[tuple[str, str], SourceReport],
) -> TelemetryProblem:
    """The problem of the sub-map with ``path``; arguments as of ``estimate``.

    ``rejected``: sources, by name and kind, that an earlier solution has shown to be wrong.
    """
    usable = UsableSeries.of(telemetry, path, rejected)
    compasses = [each for each in usable.attitude if (each.source, "heading") not in rejected]
    declination = declination_of(telemetry, config)
    problem = orient(usable, compasses, path, config, mounting, carried, declination)
    extra = [factor for factor in extra if (factor.source, factor.kind) not in rejected]
    problem.reports += usable.left_out
    _scale(problem, usable, path, extra)
    if problem.level:
        for depth in usable.depth:
            problem.factors.append(DepthFactor(depth, path))
            problem.prior[SHIFT.start + 2] = OPEN_M
    if problem.mounted:
        for velocity in usable.velocity:
            factor = VelocityFactor(velocity, path)
            if len(factor.t_s):
                problem.factors.append(factor)
            else:
                why = "no second without a gap in it"
                problem.reports.append(SourceReport(velocity.source, "velocity", reason=why))
        _add_altitudes(problem, usable, path, points)
    if problem.level:
        _add_positions(problem, usable, path, None if carried is None else carried.origin)
    _move_to_depth(problem, usable, path)
    if carried is not None and carried.place is not None and problem.level:
        _add_place(problem, path, *carried.place)
        problem.origin = problem.origin or carried.origin
    problem.factors += extra
    return problem


def _scale(
    problem: TelemetryProblem, usable: UsableSeries, path: CameraPath, extra: Sequence[Factor]
) -> None:
    """A rough scale, from the source that gives the best one."""
    guesses = [rough.scale_from_velocity(velocity, path) for velocity in usable.velocity]
    if problem.level:
        R_nm = problem.start.R_nm
        guesses += [rough.scale_from_depth(depth, path, R_nm) for depth in usable.depth]
    guesses += [factor.rough_scale for factor in extra if isinstance(factor, LengthFactor)]
    known = [guess for guess in guesses if guess is not None]
    if known:
        problem.start = replace(problem.start, log_scale=float(np.log(known[0])))


def _add_altitudes(
    problem: TelemetryProblem, usable: UsableSeries, path: CameraPath, points: Callable[[], Array]
) -> None:
    if not usable.altitude:
        return
    ground = points()
    for altitude in usable.altitude:
        factor = AltitudeFactor(altitude, path, ground, problem.start)
        if len(factor.t_s) < LEAST_SAMPLES:
            why = "its beam meets nothing of the map"
            problem.reports.append(SourceReport(altitude.source, "altitude", reason=why))
            continue
        if not any(f.kind in ("velocity", "depth") for f in problem.factors):
            for _ in range(2):  # where the altimeter is, by the camera's pose, depends on the scale
                problem.start = replace(problem.start, log_scale=factor.rough_log_scale)
                factor = AltitudeFactor(altitude, path, ground, problem.start)
        problem.factors.append(factor)


def _add_positions(
    problem: TelemetryProblem,
    usable: UsableSeries,
    path: CameraPath,
    origin: Origin | None,
) -> None:
    """Fixes on the earth: they also give the heading and the scale."""
    for fixes in usable.position:
        latitude, longitude, sigma = fixes.values.T
        if origin is None:
            near = int(np.argmin(sigma))
            place = float(latitude[near]), float(longitude[near])
            origin = Origin(*place, fixes.source, float(sigma[near]))
        at = (origin.latitude_deg, origin.longitude_deg)
        fixes_n = north_east(latitude, longitude, at)
        factor = PositionFactor(fixes.source, fixes.t_s, fixes_n, sigma, path)
        problem.factors.append(factor)
        problem.origin = origin
        problem.prior[SHIFT.start : SHIFT.start + 2] = OPEN_M
        fitted = rough.level_fit(fixes_n, path.at(fixes.t_s)[1] @ problem.start.R_nm.T)
        if fitted is not None and not problem.compass:
            scale, turn = fitted
            R_nm = rough.turned_about_down(problem.start.R_nm, turn)
            problem.start = replace(problem.start, R_nm=R_nm)
            problem.prior[TURN.stop - 1] = ANY_TURN
            if not usable.velocity:
                problem.start = replace(problem.start, log_scale=float(np.log(scale)))
        _, p_n = problem.start.body(*path.at(fixes.t_s))
        t_n = problem.start.t_n.copy()
        t_n[:2] += np.median(fixes_n - p_n[:, :2], axis=0)
        problem.start = replace(problem.start, t_n=t_n)


def _add_place(
    problem: TelemetryProblem,
    path: CameraPath,
    t_s: float,
    place_n: Array,  # [2] m
    covariance: Array,  # [2, 2] m^2
) -> None:
    """Where dead reckoning has the body at the start of the sub-map."""
    moment = np.array([min(max(t_s, path.t_s[0]), path.t_s[-1])])
    sigma = np.array([np.sqrt(0.5 * np.trace(covariance))])
    factor = PlaceFactor("dead reckoning", moment, place_n[None], sigma, path)
    problem.factors.append(factor)
    problem.prior[SHIFT.start : SHIFT.start + 2] = OPEN_M
    problem.prior[LAG] = 1e-6
    _, p_n = problem.start.body(*path.at(moment))
    t_n = problem.start.t_n.copy()
    t_n[:2] += place_n - p_n[0, :2]
    problem.start = replace(problem.start, t_n=t_n)


def _move_to_depth(problem: TelemetryProblem, usable: UsableSeries, path: CameraPath) -> None:
    """Start where the vehicle is: at its depth, and n's origin at its first pose."""
    _, p_n = problem.start.body(path.R_mc, path.p_m)
    t_n = problem.start.t_n.copy()
    if problem.origin is None:
        t_n[:2] -= p_n[0, :2]
    t_n[2] -= p_n[0, 2]
    for depth in usable.depth[:1] if problem.level else ():
        _, at = problem.start.body(*path.at(depth.t_s))
        t_n[2] = problem.start.t_n[2] + float(np.median(depth.values[:, 0] - at[:, 2]))
    problem.start = replace(problem.start, t_n=t_n)


# --------------------------------------------------------------------------------------------------
# What a compass's north differs from true north: the magnetic declination, unless it is applied.
#
# ArduPilot's vehicles, ArduSub among them, look the declination up and add it to their heading from
# the moment that they know where they are (AP_Compass.cpp, ``try_set_initial_location``;
# COMPASS_AUTODEC is 1 by default). Without a position of their own they add COMPASS_DEC, which is 0
# by default, so that their heading is magnetic (bluerobotics/qgroundcontrol, issue 143).

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
