"""How well an adjustment knows the relative poses that it found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.tracking.adjustment.block_matrix import SIDE, BlockPattern
from aquaflow.tracking.adjustment.equations import (
    AnchorMatches,
    Array,
    Index,
    Mask,
    equations_and_scores,
)
from aquaflow.tracking.adjustment.links import Links
from aquaflow.tracking.adjustment.solver import BundleState, linearise

CLUSTER = 4
"""Consecutive points of an anchor, row by row, whose errors count as one draw: neighbouring matches
err together. Clusters of 1, 4 and 16 points: 1.4, 1.9 and 1.7 times the variance (reef clip)."""
DENSE_POSES = 100
"""Above, the inverse of the equations is not worth its time: the usual factor is taken."""
USUAL_INFLATION = 1.8
"""Read off five real clips and three synthetic dives: 1.5 to 2.7."""


def covariance(
    matches: Sequence[AnchorMatches],
    links: Links,
    state: BundleState,
    free: Mask,  # [K]
) -> Array:
    """[7 F, 7 F] of the steps of the free poses, seen from those that are held.

    Raises:
        numpy.linalg.LinAlgError: a pose is not determined at all.
    """
    pattern = BlockPattern.of(matches, links, free)
    return np.asarray(np.linalg.inv(linearise(matches, links, state, pattern).H.toarray()))


def inflation(
    matches: Sequence[AnchorMatches],
    links: Links,
    state: BundleState,
    free: Mask,  # [K]
) -> float:
    """Factor of the variance by which matches that err together are worth less than independent
    ones: by how much more the pulls of clusters vary than the noise alone would make them
    (cluster-robust variance: Liang and Zeger, Biometrika 1986); at least 1.

    Raises:
        numpy.linalg.LinAlgError: a pose is not determined at all.
    """
    if free.sum() > DENSE_POSES:
        return USUAL_INFLATION
    inverse = covariance(matches, links, state, free)
    place = np.where(free, np.cumsum(free) - 1, -1)
    variation, expected = 0.0, 0.0
    for anchor, rho in zip(matches, state.rho, strict=True):
        part, scores = equations_and_scores(anchor, state.poses, rho)
        at, inside = unknowns(place[anchor.places])
        starts = np.arange(0, len(scores), CLUSTER)
        scores = np.add.reduceat(scores[:, inside], starts) if len(starts) else scores
        own = inverse[np.ix_(at, at)]
        variation += float(((scores @ own) * scores).sum()) if len(starts) else 0.0
        expected += float((part.H[np.ix_(inside, inside)] * own).sum())
    return max(1.0, variation / max(expected, 1e-12))


def of_edge(
    inverse: Array,  # [7 F, 7 F]
    place: Index,  # [K] of every pose among the free ones; -1 where held
    a: int,
    b: int,
    T_ab: Sim3Batch,  # [1]
) -> Array:
    """[7, 7] covariance of T_ab exp(d), between the poses a and b."""
    back = -T_ab.inverse().adjoint()[0]
    J = np.zeros((7, len(inverse)))
    for pose, by_pose in ((a, back), (b, np.eye(7))):
        if place[pose] >= 0:
            J[:, 7 * place[pose] : 7 * place[pose] + 7] = by_pose
    return np.asarray(J @ inverse @ J.T)


def unknowns(
    places: Index,  # [1 + V] among the free poses; -1 for those that are held
) -> tuple[Index, Index]:
    """Unknowns [u] of the free ones among ``places``, and where they stand in their block [u]."""
    columns = (SIDE * places[:, None] + np.arange(SIDE)).ravel()
    inside = np.flatnonzero(np.repeat(places >= 0, SIDE))
    return columns[inside], inside
