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

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.optimise.least_squares import NormalEquations, Rules, covariance_of, minimise
from aquaflow.optimise.robust import Huber

Array = npt.NDArray[np.float64]

FLOOR = np.array([0.01, 0.01, 0.01, 0.003, 0.003, 0.003, 0.01])
"""1 sigma that a link has at least: translation in units of the keyframe (about its depth), rad,
log-scale. What a keyframe's depths have in common does not average out over its keypoints, and the
base has errors of its own: judgement, ten times what the pose solver states."""
DRIFT = np.array([0.03, 0.03, 0.03, 0.01, 0.01, 0.01, 0.02])
"""1 sigma of drift for each depth that the camera travelled: three times that of the worst shared
clip (notes/2026-11-benchmarks.md), because the base has drifted too."""
LARGEST_CHI2 = 24.3
"""Of seven numbers: chance exceeds it once in a thousand times."""
RULES = Rules(iterations=10, sigmas=1e-3, damping=0.0)
"""The links agree, so that three iterations are enough."""
KERNEL = Huber(3.0)
"""Of a link's seven numbers together."""


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
    problem = _Placement(
        Sim3Batch.of([link.T_sk for link in links]),
        Sim3Batch.of(list(poses)),
        0.5 * np.stack([link.information for link in links]),
    )
    start = Sim3Batch.of([links[-1].T_sk @ poses[-1].inverse()])
    T_sm = minimise(problem, start, RULES).state
    size = problem.sizes(problem.residuals(T_sm))
    scatter = float((KERNEL.weight(size) * size**2).sum()) / max(7 * (len(links) - 1), 1)
    covariance = covariance_of(problem.linearise(T_sm).H)
    return SubMapInBase(T_sm.element(0), covariance * max(1.0, scatter))


@dataclass(frozen=True)
class _Placement:
    """Where a sub-map lies, by N links: a problem of least squares over one similarity."""

    T_sk: Sim3Batch
    """[N] measured"""
    T_mk: Sim3Batch
    """[N]"""
    information: Array
    """[N, 7, 7] of the right tangent."""

    def residuals(self, T_sm: Sim3Batch) -> Array:
        """[N, 7]"""
        return (self.T_sk.inverse() @ (T_sm @ self.T_mk)).log()

    def sizes(
        self,
        residuals: Array,  # [N, 7]
    ) -> Array:
        """[N] sigmas"""
        chi2 = np.einsum("ni,nij,nj->n", residuals, self.information, residuals)
        return np.asarray(np.sqrt(np.maximum(chi2, 0.0)))

    def linearise(self, T_sm: Sim3Batch) -> NormalEquations:
        """The equations of a step [7] of the left tangent."""
        residuals, J = self.residuals(T_sm), (T_sm @ self.T_mk).inverse().adjoint()
        weight = KERNEL.weight(self.sizes(residuals))[:, None, None]
        weighted = weight * (J.transpose(0, 2, 1) @ self.information)
        gradient = (weighted @ residuals[:, :, None]).sum(axis=0)[:, 0]
        return NormalEquations((weighted @ J).sum(axis=0), gradient, self.cost(T_sm))

    def cost(self, T_sm: Sim3Batch) -> float:
        """Huber's, of all links."""
        return float(KERNEL.cost(self.sizes(self.residuals(T_sm))).sum())

    def move(
        self,
        T_sm: Sim3Batch,
        step: Array,  # [P]
    ) -> Sim3Batch:
        """T_sm [1] after a step [7]."""
        return (Sim3Batch.exp(step[None]) @ T_sm).on_group()
