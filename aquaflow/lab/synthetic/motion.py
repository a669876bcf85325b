"""How the vehicle's body moves: what ideal instruments at its origin would measure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.mounting import Mountings

Array: TypeAlias = npt.NDArray[np.float64]

GRAVITY_M_S2 = 9.80665
"""Standard gravity; the earth's differs from it by at most 0.3 %."""
HALF_STEP_S = 1e-3
"""Of the central difference that gives accelerations: 30 times finer than the path's splines."""


class BodyPath(Protocol):
    """Pose of the camera and attitude of the body as functions of time (s); see path.Path."""

    @property
    def R_ws(self) -> Array:
        """[3, 3] survey frame in the world."""
        ...

    @property
    def t_ws(self) -> Array:
        """[3] m"""
        ...

    def centre_w(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] m, the camera's centre in the world."""
        ...

    def velocity_w(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] m/s of the camera over ground, in the world."""
        ...

    def R_wb(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3, 3] body in the world."""
        ...

    def R_wc(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3, 3] camera in the world."""
        ...

    def rate_b(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] rad/s in the body frame."""
        ...


@dataclass(frozen=True)
class TrueBodyMotion:
    """The body's true motion as a function of time; the world has z down, 0 at the surface."""

    path: BodyPath
    mountings: Mountings

    def R_wb(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3, 3] body (forward, right, down) in the world."""
        return self.path.R_wb(t)

    def origin_w(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] m, the body's origin in the world."""
        return np.asarray(self.path.centre_w(t) - self.R_wb(t) @ self.mountings.p_bc)

    def rate_b(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] rad/s in the body frame."""
        return self.path.rate_b(t)

    def velocity_w(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] m/s of the body's origin over ground, in the world."""
        swing_b = np.cross(self.rate_b(t), self.mountings.p_bc)
        return np.asarray(self.path.velocity_w(t) - _turn(self.R_wb(t), swing_b))

    def velocity_b(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] m/s of the body's origin over ground, in the body frame."""
        return _turn(np.swapaxes(self.R_wb(t), 1, 2), self.velocity_w(t))

    def force_b(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] m/s^2, specific force at the body's origin in the body frame.

        A body at rest and level has (0, 0, -GRAVITY_M_S2).
        """
        before, after = self.velocity_w(t - HALF_STEP_S), self.velocity_w(t + HALF_STEP_S)
        force_w = (after - before) / (2.0 * HALF_STEP_S) - np.array([0.0, 0.0, GRAVITY_M_S2])
        return _turn(np.swapaxes(self.R_wb(t), 1, 2), force_w)

    def T_wc(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 4, 4] camera to world, m."""
        T = np.tile(np.eye(4), (len(t), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = self.path.R_wc(t), self.path.centre_w(t)
        return T


def _turn(
    R: Array,  # [N, 3, 3]
    vectors: Array,  # [N, 3]
) -> Array:
    return np.asarray(np.einsum("nij,nj->ni", R, vectors))
