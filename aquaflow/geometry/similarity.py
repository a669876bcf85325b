"""Sim(3): the group of rotations, translations and scale in which all poses live.

``T_ab`` maps points of frame b into frame a; poses are ``T_wc``. Tangent vectors are
``[translation (3), rotation (3), log-scale (1)]`` and act from the left: ``exp(xi) @ T``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

# Nodes on [0, 1]: 24 integrate e^(sigma t) exp(t w) to float64 accuracy for |w| <= pi and
# |sigma| <= 10, with none of the closed form's branches near zero.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS

BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Axes (forward, right, down) from (right, down, forward), for a camera that looks forward."""


def hat(
    w: Array,  # [..., 3]
) -> Array:
    """Skew-symmetric matrices [..., 3, 3] with ``hat(w) @ x == cross(w, x)``."""
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(*w.shape[:-1], 3, 3)


def so3_exp(
    w: Array,  # [3] rad
) -> Array:
    """Rotation matrix [3, 3] of the rotation vector ``w``; NaN where that is no number.

    Rodrigues' formula in Python's own floats: 5 microseconds, where SciPy, made for many rotations
    at once, takes 70. Every step of every pose comes through here.
    """
    x, y, z = w.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if not math.isfinite(angle):
        return np.full((3, 3), np.nan)
    # sin(angle) / angle and (1 - cos(angle)) / angle^2; below, both are their limits to rounding.
    half = 0.5 * angle
    ratio = math.sin(half) / half if half > 1e-9 else 1.0
    a, b = ratio * math.cos(half), 0.5 * ratio * ratio
    bx, by, bz = b * x, b * y, b * z
    return np.array(
        [
            [1.0 - by * y - bz * z, bx * y - a * z, bx * z + a * y],
            [bx * y + a * z, 1.0 - bx * x - bz * z, by * z - a * x],
            [bx * z - a * y, by * z + a * x, 1.0 - bx * x - by * y],
        ]
    )


def so3_log(
    R: Array,  # [3, 3]
) -> Array:
    """Rotation vector [3], rad, angle in [0, pi]."""
    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def nearest_rotation(
    M: Array,  # [..., 3, 3]
) -> Array:
    """Rotations R [..., 3, 3] with the largest trace of R^T M: the answer to Wahba's problem."""
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt)


def on_so3(
    R: Array,  # [..., 3, 3] nearly rotations
) -> Array:
    """The rotations [..., 3, 3] next to ``R``: by way of unit quaternions.

    A copy: SciPy's array is a view of what takes 1.2 kB, and a long dive keeps many poses.
    """
    return np.array(Rotation.from_matrix(R).as_matrix())


def quaternion_from_rotation(
    R: Array,  # [..., 3, 3]
) -> Array:
    """Unit quaternions [..., 4], wxyz, w >= 0."""
    return np.asarray(Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True))


def rotation_from_quaternion(
    wxyz: Array,  # [..., 4], normalised here
) -> Array:
    """Rotation matrices [..., 3, 3]."""
    return np.asarray(Rotation.from_quat(wxyz, scalar_first=True).as_matrix())


@dataclass(frozen=True)
class Sim3:
    """x -> scale * R @ x + t."""

    R: Array
    """[3, 3]"""
    t: Array
    """[3]"""
    scale: float = 1.0

    @staticmethod
    def identity() -> Sim3:
        """The similarity that changes nothing."""
        return Sim3(np.eye(3), np.zeros(3))

    @staticmethod
    def exp(
        xi: Array,  # [7]
    ) -> Sim3:
        """The group element of a tangent vector, exact in rotation, scale and translation."""
        sigma = float(xi[6])
        return Sim3(so3_exp(xi[3:6]), _left_jacobian(xi[3:6], sigma) @ xi[:3], float(np.exp(sigma)))

    def log(self) -> Array:
        """The tangent vector [7] whose ``exp`` is this element."""
        w, sigma = so3_log(self.R), float(np.log(self.scale))
        u = np.linalg.solve(_left_jacobian(w, sigma), self.t)
        return np.concatenate([u, w, [sigma]])

    def inverse(self) -> Sim3:
        """The similarity that undoes this one."""
        s = 1.0 / self.scale
        return Sim3(self.R.T, -s * (self.R.T @ self.t), s)

    def __matmul__(self, other: Sim3) -> Sim3:
        """Composition; the rotation is put back on SO(3), so that long products do not drift."""
        R = on_so3(self.R @ other.R)
        t = self.scale * (self.R @ other.t) + self.t
        return Sim3(R, t, self.scale * other.scale)

    def in_source_unit(self) -> Sim3:
        """The pose with scale 1 that projects every point to where this one does."""
        return Sim3(self.R, self.t / self.scale)

    def apply(
        self,
        points: Array,  # [..., 3]
    ) -> Array:
        """The points [..., 3] in the frame that this maps to."""
        return self.scale * (points @ self.R.T) + self.t

    @property
    def matrix(self) -> Array:
        """[4, 4] homogeneous matrix, scale included."""
        M = np.eye(4)
        M[:3, :3], M[:3, 3] = self.scale * self.R, self.t
        return M

    @property
    def quaternion(self) -> Array:
        """[4] wxyz."""
        return quaternion_from_rotation(self.R)

    def is_finite(self) -> bool:
        """True while every entry is a number and the scale is positive."""
        finite = np.isfinite(self.R).all() and np.isfinite(self.t).all()
        return bool(finite and np.isfinite(self.scale) and self.scale > 0.0)

    def if_finite(self) -> Sim3:
        """Itself if finite; a check before a pose is stored.

        Raises:
            ArithmeticError: an entry is not a number, or the scale is not positive.
        """
        if not self.is_finite():
            raise ArithmeticError("a pose is not finite")
        return self


def _left_jacobian(
    w: Array,  # [3] rad
    sigma: float,
) -> Array:
    """V with ``exp([u, w, sigma]).t == V @ u``: the integral of e^(sigma t) exp(t hat(w)) dt."""
    theta = float(np.linalg.norm(w))
    growth = _WEIGHTS * np.exp(sigma * _NODES)
    # sin(theta t) / theta and (1 - cos(theta t)) / theta^2 written with sinc: finite at theta = 0.
    first = float(np.sum(growth * _NODES * np.sinc(theta * _NODES / np.pi)))
    half = np.sinc(0.5 * theta * _NODES / np.pi)
    second = float(np.sum(growth * 0.5 * (_NODES * half) ** 2))
    W = hat(w)
    return float(np.sum(growth)) * np.eye(3) + first * W + second * (W @ W)


# --------------------------------------------------------------------------------------------------
# Many similarities at once: Sim(3) of ``similarity.py`` over the first axis of arrays.
#
# Conventions are those of ``Sim3``: tangents are [translation, rotation, log-scale].

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

    def if_finite(self) -> Sim3Batch:
        """Itself if all are finite; a check before poses are stored.

        Raises:
            ArithmeticError: an entry is not a number, or a scale is not positive.
        """
        entries = (self.R, self.t, self.scale)
        if not (all(np.isfinite(each).all() for each in entries) and (self.scale > 0.0).all()):
            raise ArithmeticError("a pose is not finite")
        return self

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
