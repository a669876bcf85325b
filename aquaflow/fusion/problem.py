"""A sub-map's telemetry as factors: what there is, where to start, what is known before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.config.telemetry import MountingConfig
from aquaflow.fusion import start as rough
from aquaflow.fusion.camera_path import CameraPath
from aquaflow.fusion.factors.altitude import AltitudeFactor
from aquaflow.fusion.factors.attitude import ForceFactor, HeadingFactor, TiltFactor
from aquaflow.fusion.factors.constant_depth import ConstantDepthFactor
from aquaflow.fusion.factors.depth import DepthFactor
from aquaflow.fusion.factors.factor import Factor
from aquaflow.fusion.factors.position import PlaceFactor, PositionFactor
from aquaflow.fusion.factors.velocity import VelocityFactor
from aquaflow.fusion.metric_frame import Origin, SourceReport
from aquaflow.fusion.sources import LEAST_SAMPLES, UsableSeries
from aquaflow.fusion.state import CAMERA, DVL, DVL_SCALE, HEADING, LAG, SCALE, SHIFT, TURN, P, State
from aquaflow.fusion.telemetry import Telemetry
from aquaflow.geometry.earth import north_east

Array = npt.NDArray[np.float64]

SCALE_SIGMA = 3.0
"""Log: a start's median depth may be 5 cm or 20 m."""
OPEN_M, FIXED = 1e4, 1e-3
"""1 sigma of what only telemetry can say (m), and of what is a convention where none does."""
ANY_TURN = np.pi
"""rad, 1 sigma of a turn that nothing is known of."""


@dataclass(frozen=True)
class Carried:
    """What an earlier sub-map of the dive has shown, for the next one."""

    state: State
    """Mountings and the compass's constant error are the same."""
    heading_sigma: float
    """rad, 1 sigma of the compass's error against ``state``'s."""
    place: tuple[float, Array, Array] | None
    """Moment (s), north and east [2] m of the body by dead reckoning, covariance [2, 2] m^2."""
    origin: Origin | None


@dataclass
class Problem:
    """One sub-map's sources as factors, the state to start from, and what is known before."""

    start: State
    prior: Array
    """[P] 1 sigma of each parameter."""
    factors: list[Factor] = field(default_factory=list)
    reports: list[SourceReport] = field(default_factory=list)
    """Of sources that give no factor."""
    compass: bool = False
    """True if x of n is north."""
    level: bool = False
    """True if something measures down."""
    mounted: bool = True
    """False if nothing is known of the camera's mounting."""
    origin: Origin | None = None


def problem_of(
    telemetry: Telemetry,
    path: CameraPath,
    config: FusionConfig,
    mounting: MountingConfig | None,
    points: Callable[[], Array],
    carried: Carried | None,
) -> Problem:
    """The problem of the sub-map with ``path``; arguments as of ``estimate``."""
    usable = UsableSeries.of(telemetry, path)
    problem = _oriented(usable, path, config, mounting, carried)
    problem.reports += usable.left_out
    _scaled(problem, usable, path)
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
    return problem


def _oriented(
    usable: UsableSeries,
    path: CameraPath,
    config: FusionConfig,
    mounting: MountingConfig | None,
    carried: Carried | None,
) -> Problem:
    """The problem with what says how the body and the map are turned."""
    R_bc, c_b, sigma = np.asarray(rough.AXES), np.zeros(3), np.radians(config.mounting_sigma_deg)
    mounted = mounting is not None
    if mounting is not None:
        R_bc, c_b = rough.camera_in_body(mounting)
    elif usable.attitude:
        found = rough.mounting_from_turns(usable.attitude[0], path)
        if found is not None:
            R_bc, sigma, mounted = found, ANY_TURN, True
    prior = np.empty(P)
    prior[SCALE], prior[TURN], prior[SHIFT] = SCALE_SIGMA, ANY_TURN, FIXED
    prior[CAMERA], prior[DVL] = sigma, np.radians(config.mounting_sigma_deg)
    prior[DVL_SCALE] = max(config.dvl_scale_sigma, 1e-6)
    prior[HEADING] = np.radians(config.heading_sigma_deg)
    prior[LAG] = max(config.position_lag_sigma_s, 1e-6)
    state = State(0.0, np.eye(3), np.zeros(3), R_bc, c_b, np.eye(3))
    problem = Problem(state, prior, mounted=mounted)
    if carried is not None:
        before = carried.state
        problem.start = replace(
            problem.start, R_bc=before.R_bc, R_bd=before.R_bd, heading=before.heading
        )
        problem.prior[HEADING] = carried.heading_sigma
    _add_directions(problem, usable, path, config.depth_change_sigma_m)
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


def _add_directions(
    problem: Problem, usable: UsableSeries, path: CameraPath, depth_change_sigma_m: float
) -> None:
    """Down and north, from the best source there is."""
    state = problem.start
    unknown = "how the camera is mounted in the vehicle is unknown: set fusion.camera"
    if usable.attitude and problem.mounted:
        R_nm = rough.map_to_level(usable.attitude[0], path, state.R_bc)
        for attitude in usable.attitude:
            problem.factors.append(TiltFactor.of_attitude(attitude, path))
            problem.factors.append(HeadingFactor(attitude, path))
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
    if not problem.level and usable.position:
        _add_directions_of_fixes(problem, usable, path, depth_change_sigma_m)
    if not problem.level:
        why = "nothing measures where down is"
        problem.reports += [SourceReport(s.source, "depth", reason=why) for s in usable.depth]


def _add_directions_of_fixes(
    problem: Problem, usable: UsableSeries, path: CameraPath, depth_change_sigma_m: float
) -> None:
    """Down from where fixes lie in the map, at their depths or else at a constant one."""
    depth = usable.depth[0] if usable.depth else None
    found = rough.map_from_fixes(usable.position[0], depth, path)
    if found is None:
        return
    problem.start = replace(problem.start, R_nm=found[0], log_scale=float(np.log(found[1])))
    problem.level = True
    if depth is None:
        problem.factors.append(ConstantDepthFactor(path, depth_change_sigma_m))


def _scaled(problem: Problem, usable: UsableSeries, path: CameraPath) -> None:
    """A rough scale, from the source that gives the best one."""
    guesses = [rough.scale_from_velocity(velocity, path) for velocity in usable.velocity]
    if problem.level:
        R_nm = problem.start.R_nm
        guesses += [rough.scale_from_depth(depth, path, R_nm) for depth in usable.depth]
    known = [guess for guess in guesses if guess is not None]
    if known:
        problem.start = replace(problem.start, log_scale=float(np.log(known[0])))


def _add_altitudes(
    problem: Problem, usable: UsableSeries, path: CameraPath, points: Callable[[], Array]
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
    problem: Problem,
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
    problem: Problem,
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


def _move_to_depth(problem: Problem, usable: UsableSeries, path: CameraPath) -> None:
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
