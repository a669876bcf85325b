"""Whether the scale holds in every part of a path, where no rotation shows that clocks agree.

Samples that are out of step with the pictures give a scale too, and residuals that look like noise.
But other times have other motion: parts of the path, and kinds of source, then disagree beyond what
each states of itself. What they scatter is the least that the scale's sigma can be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, ndtr, stdtrit

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.contradictions import LARGEST_ALONE, MAP_SCALE_SIGMA, SCALING
from aquaflow.telemetry.problem import TelemetryProblem
from aquaflow.telemetry.solve import Solution, solve
from aquaflow.telemetry.state import SCALE
from aquaflow.telemetry.world_frame import UNKNOWN_SIGMA

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
