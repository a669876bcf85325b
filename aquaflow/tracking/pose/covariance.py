"""Uncertainty of a solved pose: covariance and degeneracy from its normal equations.

Translation is counted in median depths here, so that it and rotation are both angles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3

Array = npt.NDArray[np.float64]
Direction = Literal["translation", "rotation", "scale"]

UNKNOWN_SIGMA = 1e3
"""Standard deviation, in median depths or radians, of a direction without information."""
ROUNDING = 1e-13
"""Share of the largest eigenvalue below which another is float64 noise, not information."""
CELLS_ACROSS = 8
"""Cells over the picture's width; the errors of matches in one cell count as one draw. Measured on
the reef clip, two poses from two halves of each frame's matches, squared distance in their stated
covariance (5.3 is honest): halves of opposite quarters 314 without cells, 61 with 24 cells across,
21 with 12, 11 with 8; halves of a fine chequerboard 57, 7, 2.3 and 1.6. What all matches of a
picture share (calibration, the keyframe's depths) no frame can see by itself."""


@dataclass(frozen=True)
class Degeneracy:
    """The eigenvalues of the normal equations, read out."""

    eigenvalues: Array
    """[n] ascending, rad^-2: the information along each principal direction."""
    weakest: Array
    """[n] unit tangent of the first: [translation in median depths, rotation, log-scale]."""
    kind: Direction
    """What ``weakest`` mostly is."""
    weakest_sigma: float
    """Standard deviation along it, rad or median depths; at most UNKNOWN_SIGMA."""
    baseline_sigmas: float
    """The translation over its own standard deviation. Below about 4 there may be none: a pure
    rotation, or a scene at infinity; nothing can be triangulated from such a frame."""

    @property
    def conditioning(self) -> float:
        """Smallest over largest eigenvalue: 0 when a direction is free."""
        return float(self.eigenvalues[0] / max(self.eigenvalues[-1], 1e-300))


def pose_covariance(
    H: Array,  # [n, n]
    scores: Array,  # [n, C], sum of weighted J' r in each cell of the picture
    T: Sim3,
    depth: float,
) -> tuple[Array, Degeneracy]:
    """Covariance [n, n] of the left tangent, and the degeneracy report.

    The covariance is the inverse of H, grown by how much more the scores vary from cell to cell
    than independent matches of the stated noise would make them: neighbouring matches err
    together, and five thousand of them are worth as few as the measured variance says
    (cluster-robust variance: Liang and Zeger, Biometrika 1986; as one factor for all directions,
    because a few dozen cells give no better estimate). It never shrinks below what the noise
    allows.
    """
    unit = np.ones(len(H))
    unit[:3] = depth
    values, vectors = np.linalg.eigh(H * unit[:, None] * unit[None, :])
    values = np.where(values > ROUNDING * max(values[-1], 0.0), values, 0.0)
    inflation = _inflation(values, vectors.T @ (scores * unit[:, None]))
    sigma = np.minimum(np.sqrt(inflation / np.maximum(values, 1e-300)), UNKNOWN_SIGMA)
    spread = vectors * sigma * unit[:, None]
    covariance = spread @ spread.T
    weakest = vectors[:, 0]
    parts = [np.linalg.norm(weakest[i : i + 3]) for i in (0, 3, 6)]
    kind: Direction = ("translation", "rotation", "scale")[int(np.argmax(parts))]
    baseline = float(np.sqrt(T.t @ np.linalg.solve(covariance[:3, :3], T.t)))
    return covariance, Degeneracy(values, weakest, kind, float(sigma[0]), baseline)


def _inflation(
    values: Array,  # [n]
    scores: Array,  # [n, C] along the eigenvectors
) -> float:
    known = values > 0.0
    if not known.any():
        return 1.0
    return max(1.0, float(((scores[known] ** 2).sum(1) / values[known]).mean()))


def cell_sums(
    scores: Array,  # [n, M]
    u: Array,  # [M] px
    v: Array,  # [M] px
    width: int,
    height: int,
) -> Array:
    """[n, C] sums of ``scores`` over square cells of the picture."""
    size = width / CELLS_ACROSS
    down = int(np.ceil(height / size))
    column = np.clip(u / size, 0, CELLS_ACROSS - 1).astype(np.intp)
    row = np.clip(v / size, 0, down - 1).astype(np.intp)
    cell = row * CELLS_ACROSS + column
    return np.stack([np.bincount(cell, each, down * CELLS_ACROSS) for each in scores])
