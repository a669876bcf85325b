"""One joint adjustment: noise estimated, outliers left out, judged by points held out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.optimise.robust import sigma_of_lengths
from aquaflow.tracking.adjustment.equations import AnchorMatches, Array, Mask, project
from aquaflow.tracking.adjustment.held_out import HeldOutVerdict, only, triangulate, verdict
from aquaflow.tracking.adjustment.links import Links
from aquaflow.tracking.adjustment.solver import BundleState, descend
from aquaflow.tracking.adjustment.uncertainty import inflation

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
