"""Many similarities at once: Sim(3) of ``similarity.py`` over the first axis of arrays.

Conventions are those of ``Sim3``: tangents are [translation, rotation, log-scale].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3, hat

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp] | npt.NDArray[np.bool_] | slice

# Nodes on [0, 1] for the translation Jacobian: 12 are good to 1e-12 for angles up to pi and scales
# within e^-2 to e^2; 5 are as good for the small residuals of a settled graph, in half the time.
_SMALL = 0.3
_FEW, _MANY = (
    (0.5 * (nodes + 1.0), 0.5 * weights)
    for nodes, weights in (np.polynomial.legendre.leggauss(count) for count in (5, 12))
)

# Bernoulli numbers over factorials, B_2k / (2k)!: the even part of x / (e^x - 1).
_BERNOULLI = (1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 1 / 47900160, -691 / 1307674368000)


@dataclass(frozen=True)
class Sim3Batch:
    """n elements of Sim(3), x -> scale * R @ x + t each."""

    R: Array
    """[n, 3, 3]"""
    t: Array
    """[n, 3]"""
    scale: Array
    """[n]"""

    @staticmethod
    def of(elements: Sequence[Sim3]) -> Sim3Batch:
        """The batch of single elements, at least one."""
        return Sim3Batch(
            np.stack([each.R for each in elements]),
            np.stack([each.t for each in elements]),
            np.array([each.scale for each in elements], dtype=np.float64),
        )

    @staticmethod
    def exp(
        xi: Array,  # [n, 7]
    ) -> Sim3Batch:
        """Group elements of tangent vectors."""
        w, sigma = xi[:, 3:6], xi[:, 6]
        R = np.asarray(Rotation.from_rotvec(w).as_matrix())
        return Sim3Batch(R, _rotate(_translation_jacobian(w, sigma), xi[:, :3]), np.exp(sigma))

    def log(self) -> Array:
        """Tangent vectors [n, 7] whose ``exp`` these are; angles in [0, pi]."""
        w = np.asarray(Rotation.from_matrix(self.R, assume_valid=True).as_rotvec())
        sigma = np.log(self.scale)
        u = np.linalg.solve(_translation_jacobian(w, sigma), self.t[:, :, None])[:, :, 0]
        return np.concatenate([u, w, sigma[:, None]], axis=1)

    def __len__(self) -> int:
        return len(self.scale)

    def __getitem__(
        self,
        index: Index,  # [K] indices, or [N] mask
    ) -> Sim3Batch:
        return Sim3Batch(self.R[index], self.t[index], self.scale[index])

    def replace(
        self,
        index: Index,  # [K] indices, or [N] mask
        other: Sim3Batch,
    ) -> Sim3Batch:
        """A copy in which ``other`` stands at ``index``."""
        R, t, scale = self.R.copy(), self.t.copy(), self.scale.copy()
        R[index], t[index], scale[index] = other.R, other.t, other.scale
        return Sim3Batch(R, t, scale)

    def element(self, i: int) -> Sim3:
        """One of them."""
        return Sim3(self.R[i].copy(), self.t[i].copy(), float(self.scale[i]))

    def inverse(self) -> Sim3Batch:
        """The inverse of each."""
        R, s = self.R.transpose(0, 2, 1), 1.0 / self.scale
        return Sim3Batch(R, -s[:, None] * _rotate(R, self.t), s)

    def __matmul__(self, other: Sim3Batch) -> Sim3Batch:
        """Composition element by element; a batch of one goes with every element."""
        t = self.scale[:, None] * _rotate(self.R, other.t) + self.t
        return Sim3Batch(self.R @ other.R, t, self.scale * other.scale)

    def on_group(self) -> Sim3Batch:
        """Rotations put back on SO(3), so that long products do not drift."""
        R = Rotation.from_quat(Rotation.from_matrix(self.R).as_quat()).as_matrix()
        return Sim3Batch(np.asarray(R), self.t, self.scale)

    def adjoint(self) -> Array:
        """[n, 7, 7] with ``T @ exp(xi) == exp(adjoint @ xi) @ T``."""
        A = np.zeros((len(self), 7, 7))
        A[:, :3, :3] = self.scale[:, None, None] * self.R
        A[:, :3, 3:6] = hat(self.t) @ self.R
        A[:, :3, 6] = -self.t
        A[:, 3:6, 3:6] = self.R
        A[:, 6, 6] = 1.0
        return A


def right_jacobian_inverse(
    xi: Array,  # [n, 7]
) -> Array:
    """[n, 7, 7] with ``log(exp(xi) @ exp(d)) == xi + J @ d`` to first order in d.

    The Bernoulli series in ad(xi); it needs angle and log-scale below 2 pi. Twelve powers leave
    2e-11 at one radian and 1e-4 at pi. Translation enters linearly, at any size.
    """
    ad = np.zeros((len(xi), 7, 7))
    turn = hat(xi[:, 3:6])
    ad[:, :3, :3] = turn + xi[:, 6, None, None] * np.eye(3)
    ad[:, :3, 3:6] = hat(xi[:, :3])
    ad[:, :3, 6] = -xi[:, :3]
    ad[:, 3:6, 3:6] = turn
    reach = float(np.abs(xi[:, 3:]).sum(axis=1).max(initial=0.0))
    # Residuals are mostly small: as many powers as leave 1e-12 of the first.
    terms = next((k for k in range(1, 6) if (reach / (2 * np.pi)) ** (2 * k) < 1e-12), 6)
    square = ad @ ad
    J = np.eye(7) + 0.5 * ad
    power = square
    for k in range(terms):
        J += _BERNOULLI[k] * power
        if k + 1 < terms:
            power = power @ square
    return np.asarray(J)


def _rotate(
    R: Array,  # [n, 3, 3]
    x: Array,  # [n, 3]
) -> Array:
    return np.asarray((R @ x[:, :, None])[:, :, 0])


def _translation_jacobian(
    w: Array,  # [n, 3]
    sigma: Array,  # [n]
) -> Array:
    """[n, 3, 3]: V with ``exp([u, w, sigma]).t == V @ u``; see ``similarity.py``."""
    theta = np.linalg.norm(w, axis=1)[:, None]
    reach = float((theta[:, 0] + np.abs(sigma)).max(initial=0.0))
    nodes, weights = _FEW if reach < _SMALL else _MANY
    growth = weights * np.exp(sigma[:, None] * nodes)
    first = (growth * nodes * np.sinc(theta * nodes / np.pi)).sum(1)
    half = np.sinc(0.5 * theta * nodes / np.pi)
    second = (growth * 0.5 * (nodes * half) ** 2).sum(1)
    W = hat(w)
    V = first[:, None, None] * W + second[:, None, None] * (W @ W)
    V[:, range(3), range(3)] += growth.sum(1)[:, None]
    return np.asarray(V)
