"""From the estimator's solution to what leaves: the frame, its covariance, and the reports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3, hat
from aquaflow.optimise.least_squares import covariance_of
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.contradictions import SCALING
from aquaflow.telemetry.factors.factor import Factor
from aquaflow.telemetry.problem import TelemetryProblem
from aquaflow.telemetry.solve import Solution
from aquaflow.telemetry.state import SCALE, SHIFT, TURN
from aquaflow.telemetry.world_frame import (
    LARGEST_SCALE_SIGMA,
    LARGEST_TILT_SIGMA,
    MAP_UNIT,
    North,
    SourceReport,
    WorldFrame,
)

Array = npt.NDArray[np.float64]

ZERO_DEPTH_SIGMA_M = 0.1
"""m, 1 sigma of a pressure sensor's zero, which nothing in the dive shows: 10 hPa of weather since
it was set, or the vehicle's top at the surface when it was."""
WORTH_NAMING = 5.0
"""A source whose own scale is less sure than the result's by more than this is not named."""


def frame_of(problem: TelemetryProblem, solution: Solution, path: CameraPath) -> WorldFrame:
    """The frame, in metres and level only as far as its covariance allows."""
    state, covariance = solution.state, _left_tangent(solution)
    if any(factor.kind == "depth" for factor in problem.factors):
        covariance[2, 2] += ZERO_DEPTH_SIGMA_M**2
    scale_sigma = float(np.sqrt(covariance[6, 6]))
    tilt_sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:5, 3:5])[-1]))
    metric, level = scale_sigma <= LARGEST_SCALE_SIGMA, tilt_sigma <= LARGEST_TILT_SIGMA
    kinds = {factor.kind for factor in problem.factors}
    T_nm = Sim3(state.R_nm, state.t_n, state.scale)
    if not metric:
        T_nm = Sim3(state.R_nm, np.zeros(3), 1.0)
    if not level:
        T_nm = Sim3(np.eye(3), np.zeros(3), T_nm.scale)
    return WorldFrame(
        T_nm,
        covariance,
        metric=metric,
        level=level,
        north=_north(problem, kinds) if level else "first keyframe",
        depth_known=metric and level and "depth" in kinds,
        origin=problem.origin if metric and level else None,
        T_bc=Sim3(state.R_bc, state.c_b) if problem.mounted else None,
        scale_source=_scale_source(problem, solution, path, scale_sigma),
        sources=(*_reports(problem, solution), *problem.reports),
    )


def _left_tangent(solution: Solution) -> Array:
    """[7, 7] of exp(xi) T_nm, from the covariance of the state's steps.

    R becomes exp(w) R, s becomes e^q s, and t becomes t + dt = e^q exp(w) t + u to first order,
    so u = dt - w x t - q t.
    """
    state = solution.state
    order = [*range(SHIFT.start, SHIFT.stop), *range(TURN.start, TURN.stop), SCALE.start]
    covariance = solution.covariance[np.ix_(order, order)]
    J = np.eye(7)
    J[:3, 3:6] = hat(state.t_n)
    J[:3, 6] = -state.t_n
    return np.asarray(J @ covariance @ J.T)


def _north(problem: TelemetryProblem, kinds: set[str]) -> North:
    if "position" in kinds or (problem.compass and problem.declination_known):
        return "true north"
    return "magnetic north" if problem.compass else "initial heading"


def _reports(problem: TelemetryProblem, solution: Solution) -> list[SourceReport]:
    """Of every factor; tilt and heading of one attitude are one source."""
    found: dict[tuple[str, str], SourceReport] = {}
    for factor, kept in zip(problem.factors, solution.kept, strict=True):
        used, rejected = int(kept.sum()), int((~kept).sum())
        key = (factor.source, factor.kind)
        before = found.get(key, SourceReport(factor.source, factor.kind))
        reason = "contradicts the samples around it" if rejected else before.reason
        found[key] = replace(before, used=used, rejected=rejected, reason=reason)
    return list(found.values())


def _scale_source(
    problem: TelemetryProblem, solution: Solution, path: CameraPath, scale_sigma: float
) -> str:
    """The sources that the scale comes from, with what each would give alone; or why none does."""
    alone = {
        factor: _alone(problem, solution, factor)
        for factor in problem.factors
        if factor.kind in SCALING
    }
    if scale_sigma <= LARGEST_SCALE_SIGMA:
        named = [
            f"{SCALING[factor.kind]} '{factor.source}' ({100.0 * sigma:.2g} %)"
            for factor, sigma in sorted(alone.items(), key=lambda each: each[1])
            if sigma <= WORTH_NAMING * scale_sigma
        ]
        return ", ".join(named)
    if not alone:
        return f"none: no telemetry measures a length; {MAP_UNIT}"
    rise = float(np.ptp(path.p_m @ solution.state.R_nm[2]))
    best = min(alone.values())
    if problem.doubt and best <= LARGEST_SCALE_SIGMA:
        return f"none: {problem.doubt}; {MAP_UNIT}"
    said = f"none: {', '.join(sorted({SCALING[factor.kind] for factor in alone}))} give the scale "
    said += f"to {100.0 * min(best, 9.99):.0f} % only"
    if {factor.kind for factor in alone} == {"depth"}:
        said += f", because the camera rose and sank by only {rise:.2g} map units"
    return f"{said}; {MAP_UNIT}"


def _alone(problem: TelemetryProblem, solution: Solution, factor: Factor) -> float:
    """Relative 1 sigma of the scale from one factor and what measures directions."""
    A = np.diag(problem.prior**-2.0)
    for other, information in zip(problem.factors, solution.information, strict=True):
        if other is factor or other.kind not in SCALING:
            A = A + information
    return float(np.sqrt(covariance_of(A)[0, 0]))
