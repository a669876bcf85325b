"""Sim(3): the group of rotations, translations and scale in which all poses live.

``T_ab`` maps points of frame b into frame a; poses are ``T_wc``. Tangent vectors are
``[translation (3), rotation (3), log-scale (1)]`` and act from the left: ``exp(xi) @ T``.
"""

from __future__ import annotations

import math
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
