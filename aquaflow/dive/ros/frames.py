"""The frames of reference of a dive by REP-103 and REP-105, which ROS and Foxglove go by.

- ``map``: the upright frame of all exports: x east, y north, z up where true north is known.
- ``base_link``: the vehicle's body, x forward, y left, z up; only where the mounting is known.
- ``camera``: the camera's body, x forward (into the scene), y left, z up.
- ``camera_optical``: z forward, x right, y down, as pictures and AquaFlow have it.

There is no ``odom``: the poses of a dive are those of the map, corrected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aquaflow.dive.placement import Placement
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame

MAP, BODY, CAMERA, OPTICAL = "map", "base_link", "camera", "camera_optical"

CAMERA_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Forward, left, up from right, down, forward (REP-103, suffix frames)."""
BODY_FROM_FRD = np.diag([1.0, -1.0, -1.0])
"""Forward, left, up from forward, right, down."""


@dataclass(frozen=True)
class FrameTransform:
    """A frame in its parent; ``T`` takes coordinates of ``child`` to those of ``parent``, rigid."""

    parent: str
    child: str
    T: Sim3


class FrameTree:
    """From ``map`` down to ``camera_optical``; every frame has one parent."""

    def __init__(self, frame: WorldFrame, where: Placement) -> None:
        """``frame`` is that of the sub-map, ``where`` how it is placed upright."""
        self._T_un = where.T_un
        camera = FrameTransform(CAMERA, OPTICAL, Sim3(CAMERA_FROM_OPTICAL, np.zeros(3)))
        self._moving, self.fixed = CAMERA, [camera]
        if frame.T_bc is not None:
            # Lengths of the mounting are metres; of a map in map units its place is unknown.
            t = frame.T_bc.t if frame.metric else np.zeros(3)
            T_bo = Sim3(BODY_FROM_FRD @ frame.T_bc.R, BODY_FROM_FRD @ t)
            self._moving = BODY
            self.fixed = [FrameTransform(BODY, CAMERA, T_bo @ camera.T.inverse()), camera]

    def moving(self, T_nc: Sim3) -> FrameTransform:
        """The link that moves, for a pose of the camera in n."""
        T_uo = self._T_un @ Sim3(T_nc.R, T_nc.t)
        T = T_uo
        for link in reversed(self.fixed):
            T = T @ link.T.inverse()
        return FrameTransform(MAP, self._moving, T)
