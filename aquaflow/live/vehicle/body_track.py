"""The body's last poses: its velocity, its last motion, and whether it jumped."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.telemetry.world_frame import WorldFrame, moved_by_frame

# --------------------------------------------------------------------------------------------------
# The body's pose in the metric world from the camera's in the map, and its covariance.

LEAST_COSINE = 0.1
"""Of the pitch. Roll and yaw cannot be told apart at 90 deg; their covariance stays finite."""


@dataclass(frozen=True)
class BodyPoseInWorld:
    """Pose of the body in the world n: north-east-down, or along the initial heading."""

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


Array = npt.NDArray[np.float64]


# --------------------------------------------------------------------------------------------------
# The body's track.

Place: TypeAlias = Callable[[Sim3], BodyPoseInWorld]
"""The body's pose for a camera pose in the sub-map, as the map's place in the world is known."""

WINDOW = 3
"""Poses that a velocity is the mean over, so that it is 0.1 s old at 10 frames/s. With five, its
error on a synthetic reef was 0.15 m/s instead of 0.09 at 0.64 m/s: all of it lag."""
LEAST_POSES = 3
"""For a velocity; from two, its scatter cannot be seen."""
LONGEST_GAP_S = 1.0
"""Between poses; after a longer one the motion is not predicted, and the velocity begins anew."""
MOST_SPEED_M_S, MOST_RATE_RAD_S = 3.0, np.pi
"""Of an ROV or AUV, while its velocity is not known yet (a BlueROV2 does 1.5 m/s)."""
MOST_ACCELERATION_M_S2, MOST_TURN_RAD_S2 = 2.0, 4.0
"""Of the same vehicles: thrusts of a fifth of the weight, half a turn within a second."""


@dataclass(frozen=True)
class BodyRates:
    """Velocity and angular rate of the body, along its own axes."""

    velocity_m_s: Array
    """[3]"""
    rate_rad_s: Array
    """[3]"""
    covariance: Array
    """[6, 6]"""


@dataclass(frozen=True)
class Sighting:
    """A camera pose in a sub-map, at the moment of exposure."""

    t_ns: int
    sub_map: int
    T_mc: Sim3


class BodyTrack:
    """Poses are computed anew from the map with its newest place in the world: a small correction
    of that place moves the whole track, and no velocity comes of it."""

    def __init__(self, jump_m: float, jump_rad: float) -> None:
        self._jump_m, self._jump_rad = jump_m, jump_rad
        self._sightings: deque[Sighting] = deque(maxlen=WINDOW)
        self._poses: list[BodyPoseInWorld] = []

    def add(self, sighting: Sighting, place: Place) -> bool:
        """Take the next pose; True if it jumped, or the place of the map did."""
        pose = place(sighting.T_mc)
        jumped = self._has_jumped(sighting, pose, place)
        if jumped or not self._continues(sighting):
            self._sightings.clear()
        self._sightings.append(sighting)
        self._poses = [place(each.T_mc) for each in self._sightings]
        return jumped

    @property
    def pose(self) -> BodyPoseInWorld:
        """The newest pose."""
        return self._poses[-1]

    def step(self) -> tuple[int, Array, Array] | None:
        """Nanoseconds, rotation vector [3] and translation [3] since the pose before, in the axes
        of the newest; None after a jump or a gap."""
        if len(self._poses) < 2:
            return None
        since_ns = self._sightings[-1].t_ns - self._sightings[-2].t_ns
        return (since_ns, *self._poses[-2].to(self._poses[-1]))

    def motion(self, sigma_m: float, sigma_rad: float) -> BodyRates | None:
        """The mean motion of the window; None while there are too few poses.

        ``sigma_m`` and ``sigma_rad`` are of one pose against the next. What the window's steps
        scatter beyond that, as an acceleration makes them, is added to the covariance.
        """
        if len(self._poses) < LEAST_POSES:
            return None
        t_s = 1e-9 * np.array([each.t_ns - self._sightings[0].t_ns for each in self._sightings])
        steps = [_mid_step(a, b) for a, b in zip(self._poses, self._poses[1:], strict=False)]
        mean = np.sum(steps, axis=0) / t_s[-1]
        rates = np.array(steps) / np.diff(t_s)[:, None]
        noise = np.diag(np.repeat([sigma_m, sigma_rad], 3) * np.sqrt(2.0) / t_s[-1]) ** 2
        scatter = (rates - mean).T @ (rates - mean) / (len(rates) * (len(rates) - 1))
        covariance = noise + block_diag(scatter[:3, :3], scatter[3:, 3:])
        return BodyRates(mean[:3], mean[3:], covariance)

    def _continues(self, sighting: Sighting) -> bool:
        """True if the motion since the newest pose is one of the same map, without a gap."""
        if not self._sightings:
            return False
        newest = self._sightings[-1]
        since_s = 1e-9 * (sighting.t_ns - newest.t_ns)
        return newest.sub_map == sighting.sub_map and 0.0 < since_s <= LONGEST_GAP_S

    def _has_jumped(self, sighting: Sighting, pose: BodyPoseInWorld, place: Place) -> bool:
        if not self._sightings:
            return False
        newest, before = self._sightings[-1], self.pose
        same_map = newest.sub_map == sighting.sub_map
        if same_map:
            corrected = place(newest.T_mc)
            if self._differ(before, corrected, 0.0, 0.0):
                return True
            before = corrected
        since_s = 1e-9 * (sighting.t_ns - newest.t_ns)
        if not 0.0 < since_s <= LONGEST_GAP_S:
            return not same_map
        slack_m = 0.5 * MOST_ACCELERATION_M_S2 * since_s**2
        slack_rad = 0.5 * MOST_TURN_RAD_S2 * since_s**2
        motion = self.motion(0.0, 0.0)
        if motion is None:
            slack_m, slack_rad = MOST_SPEED_M_S * since_s, MOST_RATE_RAD_S * since_s
        else:
            R = before.R @ so3_exp(motion.rate_rad_s * since_s)
            before = BodyPoseInWorld(R, before.t_m + before.R @ motion.velocity_m_s * since_s)
        return self._differ(before, pose, slack_m, slack_rad)

    def _differ(
        self, a: BodyPoseInWorld, b: BodyPoseInWorld, slack_m: float, slack_rad: float
    ) -> bool:
        turn, moved = a.to(b)
        too_far = float(np.linalg.norm(moved)) > self._jump_m + slack_m
        return bool(too_far or float(np.linalg.norm(turn)) > self._jump_rad + slack_rad)


def _mid_step(a: BodyPoseInWorld, b: BodyPoseInWorld) -> Array:
    """[6] translation in the axes halfway between the poses, and rotation vector."""
    turn, moved_b = a.to(b)
    return np.concatenate([so3_exp(0.5 * turn) @ moved_b, turn])
