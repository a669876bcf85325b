"""The frame of a sub-map from its camera path and the vehicle's telemetry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc, ndtr, stdtrit

from aquaflow.config import FusionConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.similarity import Sim3, hat
from aquaflow.optimise.least_squares import covariance_of
from aquaflow.telemetry.building import problem_of
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.device_clocks import DeviceClocks
from aquaflow.telemetry.factors import Factor, PositionFactor
from aquaflow.telemetry.solve import Carried, Solution, TelemetryProblem, dilution, solve
from aquaflow.telemetry.start import WHITE, Noise, camera_in_body
from aquaflow.telemetry.state import CLOCK, SCALE, SHIFT, TURN
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import (
    LARGEST_SCALE_SIGMA,
    LARGEST_TILT_SIGMA,
    MAP_UNIT,
    UNKNOWN_SIGMA,
    FixErrors,
    North,
    SourceReport,
    WorldFrame,
)

Array = npt.NDArray[np.float64]

LEAST_POSES = 5
"""Of a sub-map; a shorter one gets no frame of its own."""


@dataclass(frozen=True)
class Estimate:
    """The frame of a sub-map, and how it came about."""

    frame: WorldFrame
    problem: TelemetryProblem | None = None
    solution: Solution | None = None
    """None where no telemetry could be used."""

    def reporting(self, sources: Sequence[SourceReport]) -> Estimate:
        """The same with reports of further sources, which could not be used."""
        return replace(self, frame=replace(self.frame, sources=(*self.frame.sources, *sources)))


def estimate(
    telemetry: Telemetry,
    path: CameraPath,
    config: FusionConfig,
    mounting: MountingConfig | None,
    points: Callable[[], Array],
    extra: Sequence[Factor] = (),
    carried: Carried | None = None,
) -> Estimate:
    """The frame of the sub-map with ``path``.

    Args:
        mounting: of the camera in the body, as stated; None if nobody stated it.
        points: makes the map's points [K, 3] m, for the altimeter's beam.
        extra: factors that do not come from telemetry: known lengths.
        carried: what an earlier sub-map of the dive has shown.

    Raises:
        ArithmeticError: the residuals are not finite.
    """
    if len(path) < LEAST_POSES:
        return Estimate(WorldFrame.unknown(f"the sub-map has only {len(path)} poses"))
    if not telemetry and not extra:
        return Estimate(WorldFrame.unknown())
    R_cb = None if mounting is None else camera_in_body(mounting).R.T
    clocks = DeviceClocks.of(telemetry, path, R_cb)
    telemetry = clocks.correct(telemetry)
    rejected = clocks.left_out(telemetry)

    def problem_along(path: CameraPath, points: Callable[[], Array]) -> TelemetryProblem:
        found = problem_of(telemetry, path, config, mounting, points, carried, extra, rejected)
        found.prior[CLOCK] = clocks.sigma_of(found)
        return found

    problem, solution = _solve_consistent(partial(problem_along, path, points), rejected)
    if solution is None:
        unused = WorldFrame.unknown("no telemetry could be used")
        unused = replace(unused, sources=tuple(problem.reports))
        return Estimate(clocks.with_clocks(unused))
    unconfirmed = ""
    if clocks.leave_open(problem):
        ground = points()
        confirmation = confirmation_of(path, lambda part: problem_along(part, lambda: ground))
        if confirmation.vague:
            unconfirmed = f"not confirmed: {confirmation.in_words()}, and {clocks.why_open}"
        elif confirmation.refuted or not clocks.known:
            solution = confirmation.apply(solution)
            problem.doubt = f"{confirmation.in_words()}, and {clocks.why_open}"
    frame = frame_of(problem, solution, path)
    if unconfirmed and frame.metric:
        said = f"{frame.scale_source}; {unconfirmed}"
        frame = replace(frame, scale_confirmed=False, scale_source=said)
    return Estimate(clocks.with_clocks(frame), problem, solution)


def _solve_consistent(
    make: Callable[[], TelemetryProblem], rejected: dict[tuple[str, str], SourceReport]
) -> tuple[TelemetryProblem, Solution | None]:
    """The problem without sources that contradict the others, which are added to ``rejected``; no
    solution where no source is left."""
    while True:
        problem = make()
        if not problem.factors:
            return problem, None
        solution = solve(problem.factors, problem.start, problem.prior)
        wrong = contradiction_in(problem, solution)
        if wrong is None:
            return problem, solution
        rejected[wrong.source, wrong.kind] = SourceReport(
            wrong.source, wrong.kind, rejected=wrong.samples, reason=wrong.reason
        )


# --------------------------------------------------------------------------------------------------
# From the estimator's solution to what leaves: the frame, its covariance, and the reports.

ZERO_DEPTH_SIGMA_M = 0.1
"""m, 1 sigma of a pressure sensor's zero, which nothing in the dive shows: 10 hPa of weather since
it was set, or the vehicle's top at the surface when it was."""
WORTH_NAMING = 5.0
"""A source whose own scale is less sure than the result's by more than this is not named."""


def frame_of(problem: TelemetryProblem, solution: Solution, path: CameraPath) -> WorldFrame:
    """The frame, in metres and level only as far as its covariance allows: with a vertical also
    where that is across the ground."""
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
    upright = level or problem.on_ground
    if not upright:
        T_nm = Sim3(np.eye(3), np.zeros(3), T_nm.scale)
    frame = WorldFrame(
        T_nm,
        covariance,
        metric=metric,
        level=level,
        on_ground=upright and not level,
        north=_north(problem, kinds) if upright else "first keyframe",
        depth_known=metric and level and "depth" in kinds,
        origin=problem.origin if metric and upright else None,
        T_bc=Sim3(state.R_bc, state.c_b) if problem.mounted else None,
        scale_source=_scale_source(problem, solution, path, scale_sigma),
        sources=(*_reports(problem, solution), *problem.reports),
    )
    return replace(frame, fixes=_fix_errors(problem, solution)) if frame.georeferenced else frame


def _fix_errors(problem: TelemetryProblem, solution: Solution) -> tuple[FixErrors, ...]:
    return tuple(
        factor.errors_of_all(solution.state, kept)
        for factor, kept in zip(problem.factors, solution.kept, strict=True)
        if isinstance(factor, PositionFactor) and factor.kind == "position"
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
        factor: _sigma_alone(problem, solution, factor)
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


def _sigma_alone(problem: TelemetryProblem, solution: Solution, factor: Factor) -> float:
    """Relative 1 sigma of the scale from one factor and what measures directions."""
    A = np.diag(problem.prior**-2.0)
    for other, information in zip(problem.factors, solution.information, strict=True):
        if other is factor or other.kind not in SCALING:
            A = A + information
    i = problem.factors.index(factor)
    short = dilution(A, factor, solution.kept[i], solution.information[i])
    return float(np.hypot(np.sqrt(covariance_of(A)[0, 0]), short))


# --------------------------------------------------------------------------------------------------
# Whether the scale holds in every part of a path, where no rotation shows that clocks agree.
#
# Samples that are out of step with the pictures give a scale too, and residuals that look like
# noise. But other times have other motion: parts of the path, and kinds of source, then disagree
# beyond what each states of itself. What they scatter is the least that the scale's sigma can be.

SHORTEST_PART_S, MOST_PARTS = 2.5, 4
"""Of the path: an ROV's speed and depth change within some seconds."""
LEAST_PARTS, LEAST_PARTS_ALONE = 3, 4
"""Of the path that must show the scale where two kinds of source do, and where only one does. Of
100 simulated dives with wrong clocks one sent poses 15 sigma wrong after two parts (5 s), and one
3.5 sigma wrong after three parts of an altimeter alone; none did with these (2026-11-25)."""
CHANCE_OF_SCATTER = 0.01
"""Below, what the parts differ by is no accident."""
STATED = 3.0
"""Sigmas within which a stated scale is true: small samples have the wider tails of Student's t,
and their sigma is stated so large that as many of them hold as much."""


@dataclass(frozen=True)
class Confirmation:
    """What parts of the path and kinds of source, each for itself, say of the scale together."""

    parts: int
    """Of the path that show the scale."""
    kinds: int
    """Of source that show it."""
    sigma: float
    """Relative 1 sigma."""
    chance: float = 1.0
    """Of a scatter as large, if every estimate had the sigma that it states."""

    @property
    def refuted(self) -> bool:
        """True if the estimates contradict each other."""
        return self.chance < CHANCE_OF_SCATTER

    @property
    def vague(self) -> bool:
        """True if too little of the path shows the scale to see whether its parts agree."""
        return self.parts < (LEAST_PARTS_ALONE if self.kinds == 1 else LEAST_PARTS)

    def apply(self, solution: Solution) -> Solution:
        """The solution with a scale that is no surer than this."""
        covariance = solution.covariance.copy()
        least = min(self.sigma, UNKNOWN_SIGMA) ** 2
        covariance[SCALE, SCALE] = np.maximum(covariance[SCALE, SCALE], least)
        return replace(solution, covariance=covariance)

    def in_words(self) -> str:
        """What is missing, where the scale is not confirmed."""
        if self.vague:
            return "too little of the path has a scale of its own"
        return f"parts of the path and kinds of source agree on the scale to {self.sigma:.0%} only"


def confirmation_of(
    path: CameraPath,
    problem_along: Callable[[CameraPath], TelemetryProblem],
) -> Confirmation:
    """Estimate the scale anew from every part and every kind of source, unless the path is too
    short to have parts enough.

    ``problem_along`` a part of the path, with what telemetry says there.
    """
    parts = _parts(path)
    if len(parts) < LEAST_PARTS:
        return Confirmation(0, 0, np.inf)
    logs: list[float] = []
    variances: list[float] = []
    kinds: set[str] = set()
    shown = 0
    for part in parts:
        before = len(logs)
        problem = problem_along(part)
        others = [factor for factor in problem.factors if factor.kind not in SCALING]
        for factor in problem.factors:
            if factor.kind not in SCALING:
                continue
            alone = solve([*others, factor], problem.start, problem.prior)
            variance = float(alone.covariance[SCALE, SCALE][0, 0])
            if variance < LARGEST_ALONE**2:
                logs.append(alone.state.log_scale)
                variances.append(variance + MAP_SCALE_SIGMA**2)
                kinds.add(factor.kind)
        shown += len(logs) > before
    if len(logs) < 2:
        return Confirmation(shown, len(kinds), np.inf)
    weight, scale = 1.0 / np.array(variances), np.array(logs)
    mean = float(weight @ scale / weight.sum())
    freedom = len(scale) - 1
    scatter = float(weight @ (scale - mean) ** 2) / freedom
    sigma = float(np.sqrt(max(1.0, scatter) / weight.sum()))
    if scatter > 1.0:
        sigma *= float(stdtrit(freedom, ndtr(STATED))) / STATED
    return Confirmation(shown, len(kinds), sigma, float(chdtrc(freedom, freedom * scatter)))


def _parts(path: CameraPath) -> list[CameraPath]:
    """Consecutive parts of equal times."""
    first_s, last_s = float(path.t_s[0]), float(path.t_s[-1])
    count = int(np.clip((last_s - first_s) // SHORTEST_PART_S, 1, MOST_PARTS))
    edges = np.searchsorted(path.t_s, np.linspace(first_s, last_s, count + 1)[1:-1])
    return [
        CameraPath(t_s, R_mc, p_m)
        for t_s, R_mc, p_m in zip(
            *(np.split(each, edges) for each in (path.t_s, path.R_mc, path.p_m)), strict=True
        )
        if len(t_s) > 1
    ]


# --------------------------------------------------------------------------------------------------
# A whole source that contradicts the others: wrong units, another vehicle, a beam to the side. Its
# noise is found from its residuals, so that it ends with absurd noise, or with a scale of its own
# that the others exclude.

DIRECTIONS = ("attitude", "acceleration", "heading")
"""Kinds that measure directions; scales are compared in their axes, so they are judged first."""
SCALING = {
    "depth": "pressure depth", "velocity": "DVL", "altitude": "altimeter", "position": "position",
    "length": "known length",
}  # fmt: skip
"""Kinds that know metres, in the words of a surveyor."""
LARGEST_NOISE = {
    "attitude": np.radians(10.0), "acceleration": np.radians(20.0), "heading": np.radians(30.0),
    "depth": 1.0, "velocity": 1.0, "altitude": 1.0,
}  # fmt: skip
"""1 sigma of what lasts in a source's errors: rad, m, m in each second of a DVL. Far beyond what
instruments of an ROV do while they work (judgement: 20 times a MEMS filter's tilt error);
position fixes may be as bad as they like, and count as little."""
LARGEST_DEVIATION = 4.0
"""Joint sigmas by which the scales of two sources may differ."""
MAP_SCALE_SIGMA = 0.0125
"""Relative; the map's own scale bends along a dive, and sources weigh its parts differently. So
less than 5 % is no contradiction (judgement)."""
LARGEST_ALONE = 0.3
"""Relative 1 sigma; a source that knows the scale less well contradicts none."""


@dataclass(frozen=True)
class Contradiction:
    """A source to be left out, and why."""

    source: str
    kind: str
    samples: int
    reason: str


@dataclass(frozen=True)
class _Alone:
    """The scale that one source gives with those that measure directions."""

    factor: Factor
    log_scale: float
    variance: float
    """Of ``log_scale``, with what the map's own scale adds."""
    excess: float
    """Its noise over the data sheet's."""


def contradiction_in(problem: TelemetryProblem, solution: Solution) -> Contradiction | None:
    """The source that contradicts the others most; None if none does."""
    return (
        _absurd(problem, solution, DIRECTIONS)
        or _of_scales(problem)
        or _absurd(problem, solution, tuple(SCALING))
    )


def _absurd(
    problem: TelemetryProblem, solution: Solution, kinds: Sequence[str]
) -> Contradiction | None:
    """The source whose noise is furthest beyond what its kind of instrument can have."""
    worst, found = 1.0, None
    for factor, noise in zip(problem.factors, solution.noise, strict=True):
        limit = LARGEST_NOISE.get(factor.kind)
        if factor.kind not in kinds or limit is None:
            continue
        at_the_end = noise.white >= WHITE[-1]
        beyond = max(noise.size / limit, 2.0 if at_the_end else 0.0)
        if beyond > worst:
            worst, found = beyond, _left_out(factor, _noise_in_words(factor, noise))
    return found


def _noise_in_words(factor: Factor, noise: Noise) -> str:
    size = float(np.hypot(noise.size, noise.white * np.median(factor.sigma)))
    angle = factor.kind in DIRECTIONS
    said = f"{np.degrees(size):.0f} degrees" if angle else f"{size:.2g} m"
    return f"it differs from the camera's path by {said} (1 sigma): it measures something else"


def _of_scales(problem: TelemetryProblem) -> Contradiction | None:
    """The source whose scale differs from those of the others; of two, the noisier one."""
    scaling = [factor for factor in problem.factors if factor.kind in SCALING]
    if len(scaling) < 2:
        return None
    alone = [_alone(problem, factor) for factor in scaling]
    alone = [each for each in alone if each.variance < LARGEST_ALONE**2]
    if _disagreement(alone) <= LARGEST_DEVIATION:
        return None
    if len(alone) == 2:
        wrong = max(alone, key=lambda each: each.excess)
    else:
        wrong = min(alone, key=lambda each: _disagreement([a for a in alone if a is not each]))
    others = [each for each in alone if each is not wrong]
    weights = np.array([1.0 / each.variance for each in others])
    mean = float(weights @ [each.log_scale for each in others] / weights.sum())
    named = " and ".join(sorted({SCALING[each.factor.kind] for each in others}))
    times = float(np.exp(wrong.log_scale - mean))
    return _left_out(wrong.factor, f"its lengths are {times:.2f} times those by {named}")


def _alone(problem: TelemetryProblem, factor: Factor) -> _Alone:
    chosen = [f for f in problem.factors if f is factor or f.kind not in SCALING]
    solution = solve(chosen, problem.start, problem.prior)
    noise = solution.noise[chosen.index(factor)]
    sheet = float(np.sqrt(np.mean(factor.sigma**2) + factor.slow.least**2 + factor.slow.waves**2))
    variance = float(solution.covariance[SCALE, SCALE][0, 0]) + 0.5 * MAP_SCALE_SIGMA**2
    excess = float(np.hypot(noise.white, noise.size / sheet))
    return _Alone(factor, solution.state.log_scale, variance, excess)


def _disagreement(alone: Sequence[_Alone]) -> float:
    """Largest difference of two scales, in joint sigmas."""
    return max(
        (
            abs(a.log_scale - b.log_scale) / float(np.sqrt(a.variance + b.variance))
            for i, a in enumerate(alone)
            for b in alone[:i]
        ),
        default=0.0,
    )


def _left_out(factor: Factor, reason: str) -> Contradiction:
    return Contradiction(factor.source, factor.kind, len(factor.t_s), reason)
