"""The judge of an adjustment: reprojection error of points that took no part in it.

Their depths are triangulate from the poses that are judged, so no depth of a pointmap is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.tracking.adjustment.equations import (
    KERNEL,
    AnchorMatches,
    Array,
    Mask,
    project,
)

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
