"""How the second dive's surface is laid onto the first's, and how well.

Point-to-plane ICP over the seven parameters of a similarity (Y. Chen, G. Medioni, "Object modelling
by registration of multiple range images" (1992)), with Tukey's weights, so that what changed has no
say. Pairs are found anew and their reach narrows at every step, so that there is no one cost for
``optimise.minimise`` to reduce. Its covariance allows for errors that neighbours share: residuals
are summed over blocks of the ground before they are squared (the cluster-robust "sandwich": H.
White, Econometrica 48 (1980); K.- Y. Liang, S. Zeger, Biometrika 73 (1986)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from aquaflow.base.errors import InputError
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.optimise.robust import Tukey, sigma_of

Array = npt.NDArray[np.float64]

MOST_POINTS = 20_000
"""Of the second surface that are compared; more change a mean over as many little."""
STEPS = 40
"""At most; on the synthetic reef it stands still after 10 to 15."""
STILL = 1e-3
"""Of the resolution: a step that moves points by less is the last."""
NARROWING = 0.7
"""By which the largest distance of pairs shrinks from step to step, to 3 resolutions."""
NARROWEST = 3.0
LEAST_SHARED = 0.1
"""Share of the second surface's points that lie on the first, or they did not see one place."""
BLOCKS_ALONG = 8.0
"""Blocks of the ground along its longer side, at least, over which errors are taken as shared."""
LEAST_BLOCK = 8.0
"""Side of a block in resolutions, at least."""


@dataclass(frozen=True)
class Registration:
    """How the second surface has to be moved."""

    T: Sim3
    """In the ground axes, after what was known before."""
    covariance: Array
    """[7, 7] of the left tangent of T: translation, rotation (rad), log-scale."""
    middle: Array
    """[3] of the shared ground, which the tangent is taken about."""
    spread: float
    """Of the residuals, 1 sigma."""
    shared: float
    """Share of the second surface's points that lie on the first."""

    def sigma_along(
        self,
        points: Array,  # [N, 3]
        normals: Array,  # [N, 3]
    ) -> Array:
        """[N] 1 sigma of places along their normals; 0 where a normal is NaN."""
        rows = _rows(points - self.middle, np.nan_to_num(normals))
        variance = np.einsum("ni,ij,nj->n", rows, self.covariance, rows)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def register(
    fixed: Array,  # [N, 3]
    normals: Array,  # [N, 3] of the fixed points, unit
    moving: Array,  # [M, 3]
    resolution: float,
    start: float,
) -> Registration:
    """The similarity that lays ``moving`` onto ``fixed``.

    Args:
        resolution: distance below which neither surface tells points apart.
        start: largest distance between the two at first.

    Raises:
        InputError: too little of the one lies near the other.
    """
    tree = cKDTree(fixed)
    step = max(1, len(moving) // MOST_POINTS)
    sample, T, reach = moving[::step], Sim3.identity(), start
    middle = np.median(fixed, axis=0)
    for _ in range(STEPS):
        points = T.apply(sample)
        pair = _pairs(tree, normals, points, reach)
        share = len(pair.which) / len(sample)
        if share < LEAST_SHARED:
            raise InputError(
                f"only {share:.0%} of the second dive's ground lies within {reach:.2g} of the "
                "first's; give the --transform between their frames, or dives over one place"
            )
        rows = _rows(points[pair.which] - middle, pair.normals)
        spread = sigma_of(pair.residuals)
        weights = Tukey().weight(pair.residuals / max(spread, 1e-9 * resolution))
        change = _solve(rows, -pair.residuals, weights)
        T = _about(middle, change) @ T
        done = (
            reach <= NARROWEST * resolution
            and _largest_move(change, points - middle) < STILL * resolution
        )
        reach = max(NARROWEST * resolution, NARROWING * reach)
        if done:
            break
    covariance = _sandwich(rows, pair.residuals, weights, points[pair.which], resolution)
    return Registration(T, covariance, middle, spread, share)


@dataclass(frozen=True)
class _Pairs:
    which: npt.NDArray[np.intp]
    normals: Array
    residuals: Array


def _pairs(
    tree: cKDTree,
    normals: Array,  # [N, 3]
    points: Array,  # [M, 3]
    reach: float,
) -> _Pairs:
    distance, nearest = tree.query(points, distance_upper_bound=reach)
    which = np.flatnonzero(np.isfinite(distance))
    nearest = np.asarray(nearest)[which]
    of = normals[nearest]
    offset = points[which] - tree.data[nearest]
    return _Pairs(which, of, (offset * of).sum(axis=1))


def _rows(
    offsets: Array,  # [N, 3] from the middle
    normals: Array,  # [N, 3]
) -> Array:
    """[N, 7] change of the distance along the normals with translation, rotation, log-scale."""
    turned = np.cross(offsets, normals)
    return np.column_stack([normals, turned, (offsets * normals).sum(axis=1)])


def _solve(
    rows: Array,  # [N, 7]
    wanted: Array,  # [N]
    weights: Array,  # [N]
) -> Array:
    """[7]; directions that nothing tells of (a plane's own) stay as they are."""
    normal = rows.T @ (weights[:, None] * rows)
    return np.asarray(
        np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ (rows.T @ (weights * wanted))
    )


def _about(
    middle: Array,  # [3]
    change: Array,  # [7]
) -> Sim3:
    """The similarity of a small change about ``middle``."""
    R = so3_exp(change[3:6])
    scale = float(np.exp(change[6]))
    return Sim3(R, middle + change[:3] - scale * (R @ middle), scale)


def _largest_move(
    change: Array,  # [7]
    offsets: Array,  # [N, 3]
) -> float:
    """Largest way that a point goes."""
    size = float(np.linalg.norm(offsets, axis=1).max())
    return float(np.linalg.norm(change[:3]) + size * np.linalg.norm(change[3:]))


def _sandwich(
    rows: Array,  # [N, 7]
    residuals: Array,  # [N]
    weights: Array,  # [N]
    points: Array,  # [N, 3]
    resolution: float,
) -> Array:
    """[7, 7]"""
    size = points.max(axis=0) - points.min(axis=0)
    side = max(float(size.max()) / BLOCKS_ALONG, LEAST_BLOCK * resolution)
    cells = np.floor(points / side).astype(np.int64)
    block = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    scores = np.zeros((int(block.max()) + 1, 7))
    np.add.at(scores, block, rows * (weights * residuals)[:, None])
    bread = np.linalg.pinv(rows.T @ (weights[:, None] * rows), rcond=1e-9, hermitian=True)
    return np.asarray(bread @ (scores.T @ scores) @ bread)
