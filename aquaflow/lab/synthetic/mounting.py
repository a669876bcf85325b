"""The frames of a dive, and how its camera and its DVL are mounted: as stated, and in truth.

The survey frame has x along the lanes, y to the right and z down, with the mean floor at z = 0.
World is NED-like (z down, 0 at the surface). For floors the two differ by the depth only; for the
scenes that are faced (a wall, a hull, a net) the survey's x points up and its z points into them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.config.stage import MountingConfig
from aquaflow.lab.synthetic.config import FACED, SyntheticConfig
from aquaflow.lab.synthetic.streams import stream

Array: TypeAlias = npt.NDArray[np.float64]


def survey_to_world(config: SyntheticConfig) -> tuple[Array, Array]:
    """R_ws [3, 3] and t_ws [3] (m)."""
    offset = np.array([0.0, 0.0, config.floor_depth_m])
    if config.scene in FACED:
        # Columns: survey x is up, survey y is east, survey z (into the wall) is north.
        return np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), offset
    return np.eye(3), offset


@dataclass(frozen=True)
class Mountings:
    """Rotations into the body (forward, right, down) of what is mounted on it, and places on it."""

    stated: MountingConfig
    """Of the camera, as the user believes it and would put it into a vehicle's configuration."""
    R_bc_stated: Array
    """[3, 3] from camera axes, the same."""
    R_bc: Array
    """[3, 3] from camera axes, in truth: ``R_bc_stated`` times the camera's mounting error."""
    p_bc: Array
    """[3] m, the camera's centre in the body; stated without error."""
    R_bd: Array
    """[3, 3] from the axes of the DVL's samples, in truth; stated as the identity."""

    @property
    def T_bc(self) -> Array:
        """[4, 4] camera to body, m, in truth."""
        return _transform(self.R_bc, self.p_bc)

    @property
    def T_bc_stated(self) -> Array:
        """[4, 4] camera to body, m, as stated."""
        return _transform(self.R_bc_stated, self.p_bc)


def mountings_of(config: SyntheticConfig) -> Mountings:
    """The mountings of a dive; each error turns by ``mounting_error_deg`` about a random axis."""
    pitch = math.radians(config.camera_pitch_deg)
    c, s = math.cos(pitch), math.sin(pitch)
    survey = np.array([[0.0, -s, c], [1.0, 0.0, 0.0], [0.0, c, s]])
    R_bc = np.asarray(survey_to_world(config)[0] @ survey)
    # Level is along the lanes; at a wall, whose lanes go up, it is into the wall.
    level_deg = 90.0 if config.scene in FACED else 0.0
    stated = MountingConfig(
        position_m=config.camera_position_m, pitch_deg=level_deg - config.camera_pitch_deg
    )
    place = np.array(config.camera_position_m)
    if config.mounting_error_deg == 0.0:
        return Mountings(stated, R_bc, R_bc, place, np.eye(3))
    axes = stream(config.seed, "mounting").standard_normal((2, 3))
    axes *= math.radians(config.mounting_error_deg) / np.linalg.norm(axes, axis=1, keepdims=True)
    of_camera, of_dvl = Rotation.from_rotvec(axes).as_matrix()
    return Mountings(stated, R_bc, R_bc @ of_camera, place, of_dvl)


def _transform(
    R: Array,  # [3, 3]
    t: Array,  # [3] m
) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T
