"""A whole source that contradicts the others: wrong units, another vehicle, a beam to the side.

The noise of a source is found from its residuals, so one that is altogether wrong ends with absurd
noise, or with a scale of its own that the others exclude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aquaflow.telemetry.factors import Factor
from aquaflow.telemetry.solve import Solution, TelemetryProblem, solve
from aquaflow.telemetry.start import WHITE, Noise
from aquaflow.telemetry.state import SCALE

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
    noise = solution.noise[next(i for i, f in enumerate(chosen) if f is factor)]
    sheet = float(np.sqrt(np.mean(factor.sigma**2) + factor.slow.least**2))
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
