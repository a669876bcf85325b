"""A sub-map's telemetry as the factors of a problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.earth import north_east
from aquaflow.geometry.similarity import BODY_FROM_CAMERA
from aquaflow.telemetry import start as rough
from aquaflow.telemetry.altimeter import AltitudeFactor
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors import (
    ConstantDepthFactor,
    DepthFactor,
    Factor,
    ForceFactor,
    HeadingFactor,
    LengthFactor,
    PlaceFactor,
    PositionFactor,
    TiltFactor,
    VelocityFactor,
)
from aquaflow.telemetry.ground_plane import SLOPE_SIGMA, down_into_ground
from aquaflow.telemetry.solve import ANY_TURN, FIXED, OPEN_M, Carried, TelemetryProblem
from aquaflow.telemetry.state import (
    CAMERA,
    CLOCK,
    DVL,
    DVL_SCALE,
    HEADING,
    LAG,
    SCALE,
    SHIFT,
    TURN,
    MetricState,
    P,
)
from aquaflow.telemetry.telemetry import Series, Telemetry, device_of
from aquaflow.telemetry.utc import fit_utc
from aquaflow.telemetry.world_frame import Origin, SourceReport
from aquaflow.types import KINDS, Attitude, Position

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
    problem = orient(usable, compasses, path, config, mounting, carried, declination, points)
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


# --------------------------------------------------------------------------------------------------
# How the body and the map are turned: the problem with factors of where down and north are.

SCALE_SIGMA = 3.0
"""Log: a start's median depth may be 5 cm or 20 m."""


def orient(
    usable: UsableSeries,
    compasses: Sequence[Series],
    path: CameraPath,
    config: FusionConfig,
    mounting: MountingConfig | None,
    carried: Carried | None,
    declination: float | None,
    points: Callable[[], Array],
) -> TelemetryProblem:
    """The problem with what says how the body and the map are turned; ``compasses`` are the
    attitudes whose heading counts, and ``declination`` what to add to it, rad."""
    problem = _as_mounted(usable, path, config, mounting)
    if config.heading and declination is not None:
        problem.start = replace(problem.start, heading=-declination)
        problem.declination_known = True
    if carried is not None:
        before = carried.state
        problem.start = replace(
            problem.start, R_bc=before.R_bc, R_bd=before.R_bd, heading=before.heading
        )
        problem.prior[HEADING] = carried.heading_sigma
        problem.declination_known |= carried.true_north
    _add_directions(problem, usable, compasses, path)
    _add_directions_of_fixes(problem, usable, path, config.depth_change_sigma_m, points)
    if not problem.level:
        why = "nothing measures where down is"
        problem.reports += [SourceReport(s.source, "depth", reason=why) for s in usable.depth]
    # The attitude filter's heading goes on through a loss, whether x of n is north or not.
    follows = carried is not None and any(f.kind == "heading" for f in problem.factors)
    problem.compass = config.heading and any(f.kind == "heading" for f in problem.factors)
    if not problem.compass and not follows:
        problem.prior[HEADING] = ANY_TURN
        # By convention the body's first heading is x of n.
        R_nb = problem.start.body(path.R_mc[:1], path.p_m[:1])[0][0]
        first = rough.heading_of(R_nb)
        R_nm = rough.turned_about_down(problem.start.R_nm, -first)
        problem.start = replace(problem.start, R_nm=R_nm, heading=problem.start.heading + first)
        problem.prior[TURN.stop - 1] = FIXED
    return problem


def _as_mounted(
    usable: UsableSeries, path: CameraPath, config: FusionConfig, mounting: MountingConfig | None
) -> TelemetryProblem:
    """The problem with nothing but the camera's place in the body."""
    R_bc, c_b, sigma = BODY_FROM_CAMERA, np.zeros(3), np.radians(config.mounting_sigma_deg)
    mounted = mounting is not None
    if mounting is not None:
        stated = rough.camera_in_body(mounting)
        R_bc, c_b = stated.R, stated.t
    elif usable.attitude:
        found = rough.mounting_from_turns(usable.attitude[0], path)
        if found is not None:
            R_bc, sigma, mounted = found, ANY_TURN, True
    prior = np.empty(P)
    prior[SCALE], prior[TURN], prior[SHIFT] = SCALE_SIGMA, ANY_TURN, FIXED
    prior[CAMERA], prior[DVL] = sigma, np.radians(config.mounting_sigma_deg)
    prior[DVL_SCALE] = max(config.dvl_scale_sigma, 1e-6)
    prior[HEADING] = np.radians(config.heading_sigma_deg)
    prior[LAG], prior[CLOCK] = max(config.position_lag_sigma_s, 1e-6), 1e-6
    state = MetricState(0.0, np.eye(3), np.zeros(3), R_bc, c_b, np.eye(3))
    return TelemetryProblem(state, prior, mounted=mounted)


def _add_directions(
    problem: TelemetryProblem, usable: UsableSeries, compasses: Sequence[Series], path: CameraPath
) -> None:
    """Down and north, from the best source there is."""
    state = problem.start
    unknown = "how the camera is mounted in the vehicle is unknown: set fusion.camera"
    if usable.attitude and problem.mounted:
        R_nm = rough.map_to_level(usable.attitude[0], path, state.R_bc)
        for attitude in usable.attitude:
            problem.factors.append(TiltFactor.of_attitude(attitude, path))
        problem.factors += [HeadingFactor(attitude, path) for attitude in compasses]
        R_nm = rough.turned_about_down(R_nm, -state.heading)
        problem.start, problem.level = replace(state, R_nm=R_nm), True
        return
    problem.reports += [SourceReport(s.source, "attitude", reason=unknown) for s in usable.attitude]
    for force in usable.acceleration:
        factor = ForceFactor.of_force(force, path) if problem.mounted else None
        if factor is None:
            why = "it does not look like gravity" if problem.mounted else unknown
            problem.reports.append(SourceReport(force.source, "acceleration", reason=why))
            continue
        R_nm = rough.map_from_force(factor.down_b, factor.t_s, path, state.R_bc)
        problem.factors.append(factor)
        problem.start, problem.level = replace(state, R_nm=R_nm), True
    if not problem.level:
        for depth in usable.depth:
            found = rough.map_from_depth(depth, path)
            if found is not None:
                problem.start, problem.level = replace(state, R_nm=found[0]), True


def _add_directions_of_fixes(
    problem: TelemetryProblem,
    usable: UsableSeries,
    path: CameraPath,
    depth_change_sigma_m: float,
    points: Callable[[], Array],
) -> None:
    """Where nothing else does: down from where fixes lie in the map, at their depths or else at a
    constant one, and from the ground that the camera looks squarely at; a line of fixes has no
    other."""
    if problem.level or not usable.position:
        return
    depth = usable.depth[0] if usable.depth else None
    found = rough.map_from_fixes(usable.position[0], depth, path)
    if found is None:
        return
    R_nm, scale = found
    ground = points()
    down = down_into_ground(ground, np.ones(len(ground)), path.R_mc[:, :, 2])
    if down is not None:
        R_nm = rough.level_with(down)
        problem.prior[TURN][:2] = SLOPE_SIGMA
        problem.on_ground = True
        problem.reports.append(SourceReport("assumed", "level_ground", used=len(ground)))
    problem.start = replace(problem.start, R_nm=R_nm, log_scale=float(np.log(scale)))
    problem.level = True
    if depth is None:
        problem.factors.append(ConstantDepthFactor(path, depth_change_sigma_m))


# --------------------------------------------------------------------------------------------------
# Which samples the estimator can use of a dive's telemetry, and why not the others.

LEAST_SAMPLES = 5
"""Of one source while the camera had poses; fewer cannot show their noise."""
LEAST_FIXES = 3
"""Of positions, each of which states its own sigma; two would agree with any scale and heading."""
USED = ("depth", "attitude", "acceleration", "velocity", "altitude", "position")
"""Kinds of message that say something about the map's frame."""


@dataclass(frozen=True)
class UsableSeries:
    """The samples of each kind at moments when the camera had a pose."""

    depth: list[Series] = field(default_factory=list)
    attitude: list[Series] = field(default_factory=list)
    acceleration: list[Series] = field(default_factory=list)
    velocity: list[Series] = field(default_factory=list)
    altitude: list[Series] = field(default_factory=list)
    position: list[Series] = field(default_factory=list)
    left_out: list[SourceReport] = field(default_factory=list)

    @staticmethod
    def of(
        telemetry: Telemetry, path: CameraPath, rejected: Mapping[tuple[str, str], SourceReport]
    ) -> UsableSeries:
        """All sources with enough samples along the path that are not ``rejected``, which are
        given by source and kind."""
        usable = UsableSeries(left_out=list(rejected.values()))
        for kind in USED:
            for series in telemetry.of(KINDS[kind]):
                if (series.source, kind) in rejected:
                    continue
                covered = path.covers(series.t_s)
                least = LEAST_FIXES if kind == "position" else LEAST_SAMPLES
                if int(covered.sum()) < least:
                    reason = _why_not(series, path, least)
                    usable.left_out.append(SourceReport(series.source, kind, reason=reason))
                    continue
                chosen = Series(series.source, series.t_s[covered], series.values[covered])
                getattr(usable, kind).append(chosen)
        return usable


def _why_not(series: Series, path: CameraPath, least: int) -> str:
    if len(series) < least:
        return f"only {len(series)} samples"
    first, last = float(np.min(series.t_s)), float(np.max(series.t_s))
    if last < path.t_s[0] or first > path.t_s[-1]:
        return (
            f"its samples are of {first:.0f} to {last:.0f} s, the camera's poses of "
            f"{path.t_s[0]:.0f} to {path.t_s[-1]:.0f} s"
        )
    return "too few samples while the camera had a pose"
