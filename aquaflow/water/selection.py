"""Which of shading, exposure and unevenness there are: the likeliest model with and without water.

Only the richest models are fitted from the start. What a smaller one's marginal likelihood is
follows from a richer one's posterior, taken as a normal distribution: the density of the parts left
out at nothing, before and after the observations (Savage and Dickey's ratio). The likeliest is then
fitted itself.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import astuple

import numpy as np
import numpy.typing as npt

from aquaflow.water.model import WaterModel
from aquaflow.water.solver import WaterFit, descend

Array = npt.NDArray[np.float64]

NOISE = 0.005
"""Least colour noise of one observation, the mean over a patch."""
FIRST_NOISE = 0.03
"""In the first fit, which is yet to find the noise."""
FEWEST_REPEATS, MOST_REPEATS = 1.0, 100.0
"""Bounds of how often the same error is counted (solver.py)."""


def fit_likeliest(problems: Sequence[WaterModel]) -> Generator[None, None, list[WaterFit]]:
    """Of those with water and those without the likeliest each; pauses every few milliseconds.

    The richest model comes first: it says how large the errors are, and where the others start.
    """
    richest = max(problems, key=lambda problem: problem.size)
    first = yield from descend(richest, richest.start, FIRST_NOISE)
    noise = max(first.spread(), NOISE)
    first = yield from descend(richest, first.x, noise)
    repeats = min(max(first.repetition(), FEWEST_REPEATS), MOST_REPEATS)
    noise *= float(np.sqrt(repeats))
    chosen = []
    for water in (False, True):
        some = [problem for problem in problems if problem.model.water is water]
        if some:
            chosen.append((yield from _likeliest(some, first, noise)))
    return chosen


def _likeliest(
    problems: Sequence[WaterModel],
    first: WaterFit,
    noise: float,
) -> Generator[None, None, WaterFit]:
    """The likeliest of the problems, fitted."""
    best: tuple[float, WaterModel, Array] | None = None
    for rich in _richest(problems):
        fit = yield from descend(rich, rich.adopt(first.problem, first.x), noise)
        for problem in problems:
            if _contains(rich, problem):
                candidate = without(fit, problem)
                best = candidate if best is None or candidate[0] > best[0] else best
        yield
    assert best is not None
    _, problem, x = best
    # One channel may be stuck where its backscatter grows at once: tried from two sides.
    last = []
    for start in (x, problem.start):
        last.append((yield from descend(problem, start, noise)))
    return max(last, key=lambda fit: fit.log_evidence)


def _richest(problems: Sequence[WaterModel]) -> Iterator[WaterModel]:
    """Those that no other contains."""
    for problem in problems:
        if not any(other is not problem and _contains(other, problem) for other in problems):
            yield problem


def _contains(rich: WaterModel, poor: WaterModel) -> bool:
    pairs = zip(astuple(poor.model), astuple(rich.model), strict=True)
    return all(has <= may for has, may in pairs)


def without(fit: WaterFit, problem: WaterModel) -> tuple[float, WaterModel, Array]:
    """Log evidence of a smaller problem by a richer one's fit, and its parameters then."""
    kept = np.zeros(fit.problem.size, bool)
    for mine, theirs in zip(problem.parts, fit.problem.parts, strict=True):
        kept[theirs] = mine.stop > mine.start
    left_out = ~kept
    if not left_out.any():
        return fit.log_evidence, problem, fit.x
    _, rows = fit.problem.priors(fit.x)
    # What is left out has a prior of its own, of mean zero.
    prior = (rows.T @ rows)[np.ix_(left_out, left_out)]
    covariance = fit.covariance
    block = covariance[np.ix_(left_out, left_out)]
    off = fit.x[left_out]
    pull = np.linalg.solve(block, off)
    log_ratio = -0.5 * (off @ pull + np.linalg.slogdet(block)[1] + np.linalg.slogdet(prior)[1])
    x = fit.x[kept] - covariance[np.ix_(kept, left_out)] @ pull
    return fit.log_evidence + float(log_ratio), problem, x
