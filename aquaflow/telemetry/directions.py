"""How the body and the map are turned: the problem with factors of where down and north are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aquaflow.config import FusionConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.similarity import BODY_FROM_CAMERA
from aquaflow.telemetry import start as rough
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors.attitude import ForceFactor, HeadingFactor, TiltFactor
from aquaflow.telemetry.factors.constant_depth import ConstantDepthFactor
from aquaflow.telemetry.problem import ANY_TURN, FIXED, Carried, TelemetryProblem
from aquaflow.telemetry.sources import UsableSeries
from aquaflow.telemetry.state import (
    CAMERA,
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
from aquaflow.telemetry.telemetry import Series
from aquaflow.telemetry.world_frame import SourceReport

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
    _add_directions_of_fixes(problem, usable, path, config.depth_change_sigma_m)
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
    prior[LAG] = max(config.position_lag_sigma_s, 1e-6)
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
    problem: TelemetryProblem, usable: UsableSeries, path: CameraPath, depth_change_sigma_m: float
) -> None:
    """Where nothing else does: down from where fixes lie in the map, at their depths or else at a
    constant one."""
    if problem.level or not usable.position:
        return
    depth = usable.depth[0] if usable.depth else None
    found = rough.map_from_fixes(usable.position[0], depth, path)
    if found is None:
        return
    problem.start = replace(problem.start, R_nm=found[0], log_scale=float(np.log(found[1])))
    problem.level = True
    if depth is None:
        problem.factors.append(ConstantDepthFactor(path, depth_change_sigma_m))
