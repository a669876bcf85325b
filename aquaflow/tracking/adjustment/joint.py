"""One joint adjustment: noise estimated, outliers left out, judged by points held out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.optimise.robust import sigma_of_lengths
from aquaflow.tracking.adjustment.equations import (
    KERNEL,
    AnchorMatches,
    Array,
    Links,
    Mask,
    project,
)
from aquaflow.tracking.adjustment.solver import BundleState, descend, inflation

ROUNDS = 3
"""Of noise and descent; from the second on outliers are left out."""
OUTLIER_SIGMAS = 6.0
"""Noise has none; matches of another surface lie tens of standard deviations off."""
LEAST_SIGMA = 2e-5
"""Normalised plane: a hundredth of a pixel; only matches that were made up are as good."""
FEW = 10
"""Matches of a pair below which their noise says nothing: they are left out."""
LEAST_JUDGES = 20
"""Held-out points below which nothing is judged, and nothing kept."""
LEAST_GAIN = 3.0
"""Standard errors, errors in common counted, by which the held-out points must fit better."""


@dataclass(frozen=True)
class JointProblem:
    """What is to be adjusted."""

    matches: Sequence[AnchorMatches]
    held_out: Sequence[Mask]
    """[P] of each anchor: points that judge."""
    links: Links
    poses: Sim3Batch
    """[K]"""
    free: Mask
    """[K]"""


@dataclass(frozen=True)
class JointAdjustmentResult:
    """What came of it."""

    state: BundleState
    matches: Sequence[AnchorMatches]
    """Without held-out points and outliers; their noise as found, grown for errors in common."""
    verdict: HeldOutVerdict

    @property
    def better(self) -> bool:
        """True if the points that took no part fit better than before, beyond chance."""
        enough = self.verdict.points >= LEAST_JUDGES
        return enough and self.verdict.gain_sigmas > LEAST_GAIN


def adjust(problem: JointProblem, iterations: int) -> JointAdjustmentResult:
    """Adjust poses and depths; ``iterations`` bounds each of ``ROUNDS`` descents.

    Raises:
        numpy.linalg.LinAlgError: the equations hold no numbers.
    """
    judges = [
        only(each, held) for each, held in zip(problem.matches, problem.held_out, strict=True)
    ]
    matches = [
        only(each, ~held) for each, held in zip(problem.matches, problem.held_out, strict=True)
    ]
    state = BundleState(problem.poses, [_start_depths(each, problem.poses) for each in matches])
    matches = [_with_noise(each, state.poses, rho) for each, rho in _each(matches, state)]
    for number in range(ROUNDS):
        used = matches if number == 0 else [
            _without_outliers(each, state.poses, rho) for each, rho in _each(matches, state)
        ]  # fmt: skip
        state = descend(used, problem.links, state, problem.free, iterations)
        matches = [_with_noise(each, state.poses, rho) for each, rho in _each(matches, state)]
    used = [_without_outliers(each, state.poses, rho) for each, rho in _each(matches, state)]
    judges = [replace(judge, sigma=each.sigma) for judge, each in zip(judges, matches, strict=True)]
    grown = float(np.sqrt(inflation(used, problem.links, state, problem.free)))
    used = [replace(each, sigma=grown * each.sigma) for each in used]
    state = descend(used, problem.links, state, problem.free, iterations)
    return JointAdjustmentResult(state, used, verdict(judges, problem.poses, state.poses, grown))


def _each(
    matches: Sequence[AnchorMatches], state: BundleState
) -> list[tuple[AnchorMatches, Array]]:
    return list(zip(matches, state.rho, strict=True))


def _start_depths(matches: AnchorMatches, poses: Sim3Batch) -> Array:
    """[P] depths of the pointmap; triangulate where it has none."""
    unknown = ~np.isfinite(matches.variance)
    if not unknown.any():
        return matches.rho
    return np.where(unknown, triangulate(matches, poses), matches.rho)


def _with_noise(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> AnchorMatches:
    """The noise of every pair's matches from what is left of them; pairs of few are left out."""
    size = np.linalg.norm(project(matches, poses, rho).error, axis=-1)
    many = matches.used.sum(axis=1) >= FEW
    sigma = np.array([
        max(sigma_of_lengths(row[used]), LEAST_SIGMA) if enough else 1.0
        for row, used, enough in zip(size, matches.used, many, strict=True)
    ])  # fmt: skip
    return replace(matches, sigma=sigma, used=matches.used & many[:, None])


def _without_outliers(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> AnchorMatches:
    size = np.linalg.norm(project(matches, poses, rho).error, axis=-1)
    near = size < OUTLIER_SIGMAS * matches.sigma[:, None]
    return replace(matches, used=matches.used & near)


# --------------------------------------------------------------------------------------------------
# The judge of an adjustment: reprojection error of points that took no part in it.
#
# Their depths are triangulate from the poses that are judged, so no depth of a pointmap is asked.

REFINEMENTS = 2
"""Gauss-Newton steps from the linear solution: the error is then the least there is."""


def held_out_errors(matches: Sequence[AnchorMatches], poses: Sim3Batch) -> list[Array]:
    """[V, P] lengths of the errors in sigmas of every anchor; NaN where nothing is seen."""
    errors = []
    for anchor in matches:
        error = project(anchor, poses, triangulate(anchor, poses)).error
        size = np.linalg.norm(error, axis=-1) / anchor.sigma[:, None]
        errors.append(np.where(anchor.used, size, np.nan))
    return errors


@dataclass(frozen=True)
class HeldOutVerdict:
    """What points that took no part say of two sets of poses."""

    before: float
    """Mean robust cost of their matches, in sigmas."""
    after: float
    gain_sigmas: float
    """Mean fall of a point's cost, over its standard error: from the scatter from point to point,
    and grown, because matches err together."""
    points: int


def verdict(
    matches: Sequence[AnchorMatches], before: Sim3Batch, after: Sim3Batch, grown: float = 1.0
) -> HeldOutVerdict:
    """Compare poses [K] by the matches of points held out of the adjustment; errors in common make
    their standard error ``grown`` times that of independent ones."""
    falls, costs, count = [], np.zeros(2), 0
    for old, new in zip(
        held_out_errors(matches, before), held_out_errors(matches, after), strict=True
    ):
        seen = np.isfinite(old) & np.isfinite(new)
        cost = [np.where(seen, KERNEL.cost(np.where(seen, each, 0.0)), 0.0) for each in (old, new)]
        falls.append((cost[0] - cost[1]).sum(0)[seen.any(0)])
        costs += cost[0].sum(), cost[1].sum()
        count += int(seen.sum())
    fall = np.concatenate(falls) if falls else np.zeros(0)
    if len(fall) < 2:
        return HeldOutVerdict(float("nan"), float("nan"), 0.0, len(fall))
    spread = max(grown * float(fall.std()) / np.sqrt(len(fall)), 1e-12)
    return HeldOutVerdict(
        costs[0] / count, costs[1] / count, float(fall.mean()) / spread, len(fall)
    )


def triangulate(matches: AnchorMatches, poses: Sim3Batch) -> Array:
    """[P] inverse depths that fit the matches best, whatever the pointmap says; 0 at infinity."""
    at = project(matches, poses, np.zeros(len(matches.rays)))
    weight = np.where(matches.used, 1.0 / matches.sigma[:, None] ** 2, 0.0)
    seen = np.where(matches.used[..., None], matches.at, 0.0)
    way = at.t[:, None, :2] - seen * at.t[:, None, 2:]
    value = seen * at.Y[..., 2:] - at.Y[..., :2]
    rho = _ratio((weight * (way * value).sum(-1)).sum(0), (weight * (way**2).sum(-1)).sum(0))
    for _ in range(REFINEMENTS):
        at = project(matches, poses, rho)
        slope = at.t[:, None, :2] / at.z[..., None] - at.Y[..., :2] * (
            at.t[:, None, 2:] / (at.z**2)[..., None]
        )
        top = (weight * (slope * at.error).sum(-1)).sum(0)
        rho = rho - _ratio(top, (weight * (slope**2).sum(-1)).sum(0))
    return np.maximum(rho, 0.0)


def _ratio(
    top: Array,  # [P]
    bottom: Array,  # [P]
) -> Array:
    return np.asarray(top / np.maximum(bottom, 1e-12))


def only(
    matches: AnchorMatches,
    points: Mask,  # [P]
) -> AnchorMatches:
    """The matches of some of the points."""
    return replace(
        matches, rays=matches.rays[points], rho=matches.rho[points],
        variance=matches.variance[points], at=matches.at[:, points],
        used=matches.used[:, points],
    )  # fmt: skip
