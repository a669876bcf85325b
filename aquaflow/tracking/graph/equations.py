"""Residuals, robust weights and normal equations of a keyframe graph, all edges at once.

Residual of an edge: r = log(T_ab^-1 T_wa^-1 T_wb), the left-over motion in b's own frame. Poses
step from the right, T_wc exp(d), so neither the steps nor their conditioning depend on the world.
With J = right_jacobian_inverse(r) the derivatives are dr/db = J and dr/da = -J Ad(T_wb^-1 T_wa).

Sequential edges count by Huber. Loop edges are switched by dynamic covariance scaling (Agarwal et
al., ICRA 2013), s = min(1, 2 phi / (phi + chi2)), weight s^2; phi starts where every admitted loop
has full weight and falls to its own value (graduated non-convexity, Yang et al., RA-L 2020).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from aquaflow.geometry.similarity import Sim3Batch, right_jacobian_inverse
from aquaflow.optimise.robust import Huber

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[Any]
"""A structured array: NODE or EDGE rows of ``table.py``."""

DAMPING = 1e-9
"""Initial damping, over the diagonal: enough for a direction that no edge constrains."""


def poses_of(
    rows: Rows,  # [n] NODE or EDGE
) -> Sim3Batch:
    """The similarities in NODE or EDGE rows."""
    return Sim3Batch(rows["R"], rows["t"], rows["scale"])


def residuals(
    poses: Sim3Batch,
    edges: Rows,  # [m] EDGE
) -> tuple[Array, Sim3Batch]:
    """[m, 7] residuals of the edges, and T_ba of the present poses."""
    T_ba = poses[edges["b"]].inverse() @ poses[edges["a"]]
    return (poses_of(edges).inverse() @ T_ba.inverse()).log(), T_ba


def chi_squares(
    r: Array,  # [m, 7]
    edges: Rows,  # [m] EDGE
) -> Array:
    """[m] squared residuals in the metric of the edges' information."""
    return np.asarray(np.einsum("ei,eij,ej->e", r, edges["information"], r))


def trust_of(
    chi2: Array,  # [m]
    phi: Array,  # [m]
) -> Array:
    """[m] switch variables of dynamic covariance scaling."""
    return np.asarray(np.minimum(1.0, 2.0 * phi / (phi + chi2)))


def robust(
    chi2: Array,  # [m]
    loop: Mask,  # [m]
    phi: Array,  # [m], of loops only
    huber: float,
) -> tuple[Array, Array]:
    """Cost and weight [m] of every edge; the weight is the cost's derivative by chi2."""
    size = np.sqrt(np.maximum(chi2, 1e-300))
    kernel = Huber(huber)
    switched = np.where(chi2 <= phi, chi2, phi * (3.0 * chi2 - phi) / (phi + chi2))
    return (
        np.where(loop, switched, 2.0 * kernel.cost(size)),
        np.where(loop, trust_of(chi2, phi) ** 2, kernel.weight(size)),
    )


class Misfit:
    """Residuals of the edges at given poses, and their cost."""

    def __init__(
        self,
        poses: Sim3Batch,  # [n]
        edges: Rows,  # [m]
        allowed: Array,  # [m] phi of each loop edge
        huber: float,
    ) -> None:
        self.poses, self.edges, self.allowed, self.huber = poses, edges, allowed, huber
        self.r, self.T_ba = residuals(poses, edges)
        self.chi2 = chi_squares(self.r, edges)

    def move(self, poses: Sim3Batch) -> Misfit:
        """The same edges at other poses."""
        return Misfit(poses, self.edges, self.allowed, self.huber)

    def cost(self, level: float = 0.0) -> float:
        """Robust cost of all edges; ``level`` is a phi that no loop edge stays below."""
        return float(self.robust(level)[0].sum())

    def robust(self, level: float) -> tuple[Array, Array]:
        """Cost and weight [m] of every edge."""
        phi = np.maximum(self.allowed, level)
        return robust(self.chi2, self.edges["loop"], phi, self.huber)

    @property
    def strain(self) -> float:
        """Largest chi2 of a loop edge above its allowed value."""
        beyond = self.edges["loop"] & (self.chi2 > self.allowed)
        return float(self.chi2[beyond].max(initial=0.0))


class Equations:
    """Normal equations of a misfit, its edges weighted robustly; the matrix only when asked for."""

    def __init__(self, misfit: Misfit, level: float) -> None:
        self.misfit = misfit
        edges, n = misfit.edges, len(misfit.poses)
        self._information = misfit.robust(level)[1][:, None, None] * edges["information"]
        self._J = right_jacobian_inverse(misfit.r)
        self._Ad = misfit.T_ba.adjoint()
        ends = np.concatenate([edges["a"], edges["b"]])
        self._gather = sparse.csr_matrix(
            (np.ones(len(ends)), (ends, np.arange(len(ends)))), shape=(n, len(ends))
        )
        at_b = _transpose(self._J) @ self._information @ misfit.r[:, :, None]
        at_a = -_transpose(self._Ad) @ at_b
        self.gradient: Array = self._gather @ np.concatenate([at_a, at_b])[:, :, 0]
        """[n, 7]"""

    @cached_property
    def H_bb(self) -> Array:
        """[m, 7, 7] block of each edge at its b."""
        return np.asarray(_transpose(self._J) @ self._information @ self._J)

    @cached_property
    def H_ab(self) -> Array:
        """[m, 7, 7] off-diagonal block of each edge."""
        return np.asarray(-_transpose(self._Ad) @ self.H_bb)

    @cached_property
    def diagonal(self) -> Array:
        """[n, 7, 7] blocks of the matrix."""
        blocks = np.concatenate([-self.H_ab @ self._Ad, self.H_bb]).reshape(-1, 49)
        return np.asarray((self._gather @ blocks).reshape(-1, 7, 7))


def _transpose(
    blocks: Array,  # [m, 7, 7]
) -> Array:
    return blocks.transpose(0, 2, 1)


def wanted_moves(
    at: Equations,
    poses: Mask,  # [n]
) -> Array:
    """[n] sigmas that each of ``poses`` [n] would move if it alone could; zero for the others."""
    wanted = np.zeros(len(poses))
    if poses.any():
        gradient, blocks = at.gradient[poses], at.diagonal[poses]
        blocks = blocks + damping_of(blocks, DAMPING)[:, :, None] * np.eye(7)
        step = np.linalg.solve(blocks, gradient[:, :, None])[:, :, 0]
        wanted[poses] = np.sqrt(np.maximum((step * gradient).sum(axis=1), 0.0))
    return wanted


def damping_of(
    diagonal: Array,  # [n, 7, 7]
    factor: float,
) -> Array:
    """[n, 7] Levenberg's term, never zero: a pose without information stays where it is."""
    entries = np.einsum("nii->ni", diagonal)
    return np.asarray(
        factor * np.maximum(entries, 1e-3 * max(float(entries.max(initial=0.0)), 1e-9))
    )
