"""Attitude: where down is in the body, and where it points; else specific force for down."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import rotation_from_quaternion
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors.factor import MOST, Array, Factor, axes_along
from aquaflow.telemetry.noise import Process, SlowPart
from aquaflow.telemetry.state import CAMERA, HEADING, TURN, MetricState
from aquaflow.telemetry.telemetry import Series

TILT_SIGMA = np.radians(0.5)
"""rad, white: roll and pitch of a MEMS attitude filter in motion."""
HEADING_SIGMA = np.radians(1.0)
"""rad, white: a compass in a vehicle with thrusters."""
FORCE_SIGMA = 0.05
"""rad, white: an ROV's own accelerations of 0.5 m/s^2 against gravity's 9.8."""
LEAST_FORCE, MOST_FORCE = 7.0, 13.0
"""m/s^2; specific force outside is a blow, not gravity."""


class TiltFactor(Factor):
    """Measured down in the body x down of the state: the small angle between the two."""

    kind = "attitude"
    slow = SlowPart(np.radians(0.3), 20.0, tuple(Process(t) for t in (5.0, 20.0, 100.0)))
    """rad: roll and pitch of a MEMS filter wander by some tenths of a degree (Xsens MTi-30: 0.5
    degrees RMS dynamic), as long as it averages accelerations."""
    spans = (TURN, CAMERA)

    def __init__(
        self,
        source: str,
        t_s: Array,  # [N] s
        down_b: Array,  # [N, 3] unit vectors in the body
        path: CameraPath,
        sigma: float,
    ) -> None:
        """``path`` covers all samples."""
        self.source, self.t_s = source, t_s
        self.sigma = np.full(len(t_s), sigma)
        self.down_b = down_b
        self._R_mc, self._p_m = path.at(t_s)

    @staticmethod
    def of_attitude(attitude: Series, path: CameraPath) -> TiltFactor:
        """From an attitude filter."""
        attitude = attitude.thin(MOST)
        R_nb = rotation_from_quaternion(attitude.values)
        return TiltFactor(attitude.source, attitude.t_s, R_nb[:, 2, :], path, TILT_SIGMA)

    def residuals(self, state: MetricState) -> Array:
        """[N, 2] rad, across the body's down axis."""
        R_nb, _ = state.body(self._R_mc, self._p_m)
        turn = np.cross(self.down_b, R_nb[:, 2, :])
        axes = axes_along(self.down_b)[:, 1:]
        return np.asarray(np.einsum("nij,nj->ni", axes, turn))

    def turn_wanted(self, state: MetricState) -> Array:
        """[N, 3] rad, the turn in the axes of n after which down is where it was measured."""
        R_nb, _ = state.body(self._R_mc, self._p_m)
        measured = np.einsum("nij,nj->ni", R_nb, self.down_b)
        return np.cross(measured, [0.0, 0.0, 1.0])


class ForceFactor(TiltFactor):
    """The same from specific force, which is down only on average."""

    kind = "acceleration"
    slow = SlowPart(0.01, 4.0, tuple(Process(t) for t in (1.0, 4.0, 20.0)))
    """rad: accelerations of an ROV last as long as its manoeuvres."""

    @staticmethod
    def of_force(force: Series, path: CameraPath) -> ForceFactor | None:
        """From an accelerometer; None if nothing of it looks like gravity."""
        norm = np.linalg.norm(force.values, axis=1)
        sound = (norm > LEAST_FORCE) & (norm < MOST_FORCE)
        if not sound.any():
            return None
        force = Series(force.source, force.t_s[sound], force.values[sound]).thin(MOST)
        down_b = -force.values / np.linalg.norm(force.values, axis=1, keepdims=True)
        return ForceFactor(force.source, force.t_s, down_b, path, FORCE_SIGMA)


class HeadingFactor(Factor):
    """Turn about the vertical between the body of the state and the compass's."""

    kind = "heading"
    slow = SlowPart(np.radians(1.0), 60.0, tuple(Process(t) for t in (10.0, 60.0, 300.0)))
    """rad: thrusters, tethers and wrecks bend the field as the vehicle goes."""
    spans = (TURN, CAMERA, HEADING)

    def __init__(self, attitude: Series, path: CameraPath) -> None:
        """``path`` covers all samples."""
        attitude = attitude.thin(MOST)
        self.source, self.t_s = attitude.source, attitude.t_s
        self.sigma = np.full(len(attitude), HEADING_SIGMA)
        self._R_bn = np.swapaxes(rotation_from_quaternion(attitude.values), 1, 2)
        self._R_mc, self._p_m = path.at(attitude.t_s)

    def residuals(self, state: MetricState) -> Array:
        """[N, 1] rad."""
        R_nb, _ = state.body(self._R_mc, self._p_m)
        about = Rotation.from_matrix(R_nb @ self._R_bn).as_rotvec()[:, 2:]
        apart = about + state.heading
        return np.asarray(np.arctan2(np.sin(apart), np.cos(apart)))
