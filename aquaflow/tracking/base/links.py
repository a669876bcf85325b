"""Recognitions as measurements: do two of them agree, and where do they put the dive?

Each says where one keyframe lies in the base, as a Sim(3) with its information. A single one may be
false, however many keypoints it has: places that look alike exist. Two that put the dive at the
same place, turn and scale, within what the dive's own path may have drifted between them, are not
false by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.similarity_batch import Sim3Batch

Array = npt.NDArray[np.float64]

FLOOR = np.array([0.01, 0.01, 0.01, 0.003, 0.003, 0.003, 0.01])
"""1 sigma that a link has at least: translation in units of the keyframe (about its depth), rad,
log-scale. What a keyframe's depths have in common does not average out over its keypoints, and the
base has errors of its own: judgement, ten times what the pose solver states."""
DRIFT = np.array([0.03, 0.03, 0.03, 0.01, 0.01, 0.01, 0.02])
"""1 sigma of drift for each depth that the camera travelled: three times that of the worst shared
clip (docs/benchmarks.md), because the base has drifted too."""
LARGEST_CHI2 = 24.3
"""Of seven numbers: chance exceeds it once in a thousand times."""
ROUNDS = 5
"""Gauss-Newton steps; the links agree, so that three are enough."""
HUBER = 3.0
"""Sigmas beyond which a link pulls no harder."""


@dataclass(frozen=True)
class BaseLink:
    """A keyframe of this dive that was recognised in the base."""

    keyframe: int
    base_keyframe: int
    base_sub_map: int
    T_sk: Sim3
    """This dive's keyframe in the world of the base's sub-map."""
    covariance: Array
    """[7, 7] of the right tangent of ``T_sk``, :data:`FLOOR` included."""
    inliers: int
    """Keypoints that agree."""

    @property
    def information(self) -> Array:
        """[7, 7]"""
        return np.asarray(np.linalg.inv(self.covariance))


def link_covariance(
    covariance: Array,  # [7, 7] of the left tangent of T_kb, as the pose solver gives it
) -> Array:
    """[7, 7] of the right tangent of T_sk = T_sb T_kb^-1: the same but for its sign."""
    return np.asarray(covariance + np.diag(FLOOR**2))


def agree(a: BaseLink, T_ma: Sim3, b: BaseLink, T_mb: Sim3, travelled: float) -> bool:
    """True if two links put the dive at the same place.

    ``T_ma``, ``T_mb``: their keyframes in the dive's own world; ``travelled``: between them, in
    units of keyframe a.
    """
    if a.base_sub_map != b.base_sub_map:
        return False
    between = T_mb.inverse() @ T_ma
    apart = (a.T_sk.inverse() @ b.T_sk @ between).log()
    carried = Sim3Batch.of([between.inverse()]).adjoint()[0]
    drift = np.diag((DRIFT * travelled) ** 2)
    covariance = a.covariance + carried @ b.covariance @ carried.T + drift
    return bool(apart @ np.linalg.solve(covariance, apart) < LARGEST_CHI2)


@dataclass(frozen=True)
class SubMapInBase:
    """Where a sub-map of the dive lies in the base."""

    T_sm: Sim3
    covariance: Array
    """[7, 7] of its left tangent."""


def fit_sub_map(links: Sequence[BaseLink], poses: Sequence[Sim3]) -> SubMapInBase:
    """The similarity that fits all links best; ``poses``: T_mk of their keyframes, as they are now.

    Its covariance is that of the links, more where they scatter more than they state; links of
    neighbouring keyframes count as one half of a measurement each.
    """
    T_sk, T_mk = Sim3Batch.of([link.T_sk for link in links]), Sim3Batch.of(list(poses))
    information = 0.5 * np.stack([link.information for link in links])
    T_sm = Sim3Batch.of([links[-1].T_sk @ poses[-1].inverse()])
    for _ in range(ROUNDS):
        at = T_sm @ T_mk
        residual = (T_sk.inverse() @ at).log()
        J = at.inverse().adjoint()
        chi2 = np.einsum("ni,nij,nj->n", residual, information, residual)
        weight = np.minimum(1.0, HUBER / np.sqrt(np.maximum(chi2, 1e-12)))
        weighted = weight[:, None, None] * (J.transpose(0, 2, 1) @ information)
        H = (weighted @ J).sum(axis=0)
        step = -np.linalg.solve(H, (weighted @ residual[:, :, None]).sum(axis=0)[:, 0])
        T_sm = (Sim3Batch.exp(step[None]) @ T_sm).on_group()
    scatter = float((weight * chi2).sum()) / max(7 * (len(links) - 1), 1)
    return SubMapInBase(T_sm.element(0), np.linalg.inv(H) * max(1.0, scatter))
