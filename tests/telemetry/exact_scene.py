"""A dive without any noise, and what every instrument measures of it: written out, no estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import quaternion_from_rotation
from aquaflow.telemetry.altimeter import AltitudeFactor
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors import (
    ConstantDepthFactor,
    DepthFactor,
    Factor,
    ForceFactor,
    HeadingFactor,
    LengthFactor,
    PlaceFactor,
    PositionFactor,
    TiltFactor,
    VelocityFactor,
)
from aquaflow.telemetry.state import MetricState, P
from aquaflow.telemetry.telemetry import Series

Array = npt.NDArray[np.float64]

GRAVITY = 9.81
RATE_HZ = 50.0
LASTS_S = 12.0
DIFFERENCE_S = 1e-5


@dataclass(frozen=True)
class ExactScene:
    """The true state, and the camera's motion in the map."""

    state: MetricState
    flat: bool
    """True if the vehicle keeps its depth and its attitude."""
    t_s: Array
    turn: Array
    """[3, 3] amplitudes (rad) of the camera's sway."""

    @staticmethod
    def drawn(seed: int, flat: bool = False) -> ExactScene:
        """A random one."""
        rng = np.random.default_rng(seed)
        state = MetricState(
            log_scale=float(rng.uniform(-1.0, 1.0)),
            R_nm=Rotation.random(rng=rng).as_matrix(),
            t_n=rng.normal(size=3),
            R_bc=Rotation.random(rng=rng).as_matrix(),
            c_b=0.3 * rng.normal(size=3),
            R_bd=Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix(),
            log_dvl=float(rng.normal(0.0, 0.02)),
            heading=float(rng.normal(0.0, 0.3)),
        )
        t_s = np.arange(0.0, LASTS_S, 1.0 / RATE_HZ)
        return ExactScene(state, flat, t_s, 0.3 * rng.normal(size=(3, 3)))

    def body(
        self,
        t_s: Array,  # [N]
    ) -> tuple[Array, Array]:
        """R_nb [N, 3, 3] and the body's origin [N, 3] m in n, from which the camera follows."""
        if self.flat:
            angles = np.column_stack([0.2 * t_s, 0.0 * t_s, 0.0 * t_s])
        else:
            angles = np.sin(np.outer(t_s, [0.3, 0.5, 0.7])) @ self.turn
        R_nb = Rotation.from_euler("ZYX", angles).as_matrix()
        north, east = 0.4 * t_s, 1.5 * np.sin(0.4 * t_s)
        down = 5.0 + (0.0 if self.flat else 1.0) * np.sin(0.6 * t_s)
        return R_nb, np.column_stack([north, east, down])

    @property
    def path(self) -> CameraPath:
        """The camera in the map: T_mc = T_nm^-1 T_nb T_bc."""
        s = self.state
        R_nb, p_nb = self.body(self.t_s)
        camera_n = p_nb + R_nb @ s.c_b
        R_mc = s.R_nm.T @ R_nb @ s.R_bc
        return CameraPath(self.t_s, R_mc, (camera_n - s.t_n) @ s.R_nm / s.scale)

    def factors(self) -> list[Factor]:
        """Of every kind; their measurements are those of the true state."""
        s, path, t = self.state, self.path, self.t_s
        R_nb, p_nb = self.body(t)
        ahead, behind = self.body(t + DIFFERENCE_S)[1], self.body(t - DIFFERENCE_S)[1]
        v_n = (ahead - behind) / (2.0 * DIFFERENCE_S)
        v_b = np.einsum("nji,nj->ni", R_nb, v_n)
        v_d = np.exp(-s.log_dvl) * v_b @ s.R_bd
        compass = Rotation.from_euler("z", s.heading).as_matrix() @ R_nb
        wxyz = np.array([quaternion_from_rotation(R) for R in compass])
        attitude = Series("ahrs", t, wxyz)
        down_b = R_nb[:, 2, :]
        fixes = p_nb[::50, :2]
        sigma = np.full(len(fixes), 0.1)
        force = ForceFactor.of_force(Series("imu", t, -GRAVITY * down_b), path)
        assert force is not None
        length_m = 0.2
        seen = np.full(2, length_m / s.scale)
        found: list[Factor] = [
            DepthFactor(Series("pressure", t, p_nb[:, 2:]), path),
            TiltFactor.of_attitude(attitude, path),
            HeadingFactor(attitude, path),
            force,
            VelocityFactor(Series("dvl", t, np.column_stack([v_d, 0.01 + 0.0 * t])), path),
            PositionFactor("usbl", t[::50], fixes, sigma, path),
            PlaceFactor("dead reckoning", t[:1], p_nb[:1, :2], sigma[:1], path),
            LengthFactor("bar", seen, 0.001 * seen, length_m, 0.001),
        ]
        if self.flat:
            found.append(ConstantDepthFactor(path, 0.1))
        return found

    def altitude(self) -> AltitudeFactor:
        """Of a rock right below the middle of a flat way, in the beam for a while."""
        s, path = self.state, self.path
        _, p_nb = self.body(self.t_s)
        middle = len(p_nb) // 2
        rock_n = p_nb[middle] + np.array([0.0, 0.0, 3.0])
        rock_m = (rock_n - s.t_n) @ s.R_nm / s.scale
        near = slice(middle - 25, middle + 25)
        altitude = np.linalg.norm(p_nb[near] - rock_n, axis=1)
        series = Series("ping", self.t_s[near], altitude[:, None])
        return AltitudeFactor(series, path, np.tile(rock_m, (40, 1)), s)


def disturbed(state: MetricState, seed: int, size: float) -> MetricState:
    """A state near another, in every parameter."""
    step = size * np.random.default_rng(seed).normal(size=P)
    return state.move(step)
