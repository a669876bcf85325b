"""The body's pose in the metric world from the camera's in the map, and its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame, moved_by_frame

Array = npt.NDArray[np.float64]

LEAST_COSINE = 0.1
"""Of the pitch. Roll and yaw cannot be told apart at 90 deg; their covariance stays finite."""


@dataclass(frozen=True)
class BodyPoseInWorld:
    """Of the body in the world n: north-east-down, or along the initial heading."""

    R: Array
    """[3, 3] body to n."""
    t_m: Array
    """[3]"""

    def to(self, later: BodyPoseInWorld) -> tuple[Array, Array]:
        """Rotation vector [3], rad, and translation [3], m, to ``later``, in its axes."""
        turn = Rotation.from_matrix(self.R.T @ later.R).as_rotvec()
        return np.asarray(turn), later.R.T @ (later.t_m - self.t_m)


def body_pose(frame: WorldFrame, T_bc: Sim3, T_mc: Sim3) -> BodyPoseInWorld:
    """The body's pose for a camera pose ``T_mc`` in the sub-map that ``frame`` places."""
    R = frame.T_nm.R @ T_mc.R @ T_bc.R.T
    return BodyPoseInWorld(R, frame.T_nm.apply(T_mc.t) - R @ T_bc.t)


def pose_covariance(
    frame: WorldFrame,
    pose: BodyPoseInWorld,
    own: Array,  # [6, 6] of the pose in the map: position, m, and rotation vector, rad, in n
) -> Array:
    """[6, 6] of x, y, z (m) and roll, pitch, yaw (rad): the frame's own, and the pose's in it."""
    J = np.zeros((6, 7))
    J[:3] = moved_by_frame(pose.t_m)
    J[3:, 3:6] = np.eye(3)
    K = np.eye(6)
    K[3:, 3:] = _angles_by_rotation(pose.R)
    covariance = K @ (J @ frame.covariance @ J.T + own) @ K.T
    return 0.5 * (covariance + covariance.T)


def _angles_by_rotation(
    R: Array,  # [3, 3] body to n
) -> Array:
    """[3, 3] change of roll, pitch and yaw with a small rotation vector in n."""
    yaw, pitch, _ = Rotation.from_matrix(R).as_euler("ZYX")
    c = max(float(np.cos(pitch)), LEAST_COSINE)
    s, cy, sy = float(np.sin(pitch)), float(np.cos(yaw)), float(np.sin(yaw))
    return np.array([[cy / c, sy / c, 0.0], [-sy, cy, 0.0], [s * cy / c, s * sy / c, 1.0]])
