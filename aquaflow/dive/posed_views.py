"""The views of a dive's map with their cameras and poses in the upright frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.placement import Placement, placement
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.views import View, in_time
from aquaflow.telemetry.world_frame import WorldFrame


@dataclass(frozen=True)
class PosedView:
    """A frame that the map was made from."""

    frame_index: int
    """Position in the recording."""
    camera: CameraModel
    """Pinhole, of the prepared pictures."""
    T_uc: Sim3
    """Camera (x right, y down, z forward) to the upright frame; rigid, in the map's unit."""

    def shows(
        self,
        points: npt.NDArray[np.float64],  # [N, 3] camera frame
    ) -> npt.NDArray[np.bool_]:
        """[N] True for points that lie in the picture."""
        u, v = np.moveaxis(self.camera.project(points), -1, 0)
        inside = (u >= 0.0) & (u < self.camera.width) & (v >= 0.0) & (v < self.camera.height)
        return np.asarray(inside & (points[:, 2] > 0.0))


def posed_views(views: Iterable[View], frame: WorldFrame, where: Placement) -> list[PosedView]:
    """The views in the order of the recording."""
    posed = []
    for view in in_time(views):
        T_nc = frame.pose(view.T_wc)
        T_uc = where.T_un @ Sim3(T_nc.R, T_nc.t, 1.0)
        posed.append(PosedView(view.frame_index, view.camera, T_uc))
    return posed


def read_posed_views(dive: Dive, mapper: Mapper) -> tuple[list[PosedView], Placement]:
    """The views of ``mapper``, which is the map of ``dive``, and where they lie.

    Raises:
        InputError: there are none, or the dive's metric.json is damaged.
    """
    frame = dive.frame
    where = placement(frame)
    views = posed_views(mapper.views, frame, where)
    if not views:
        raise InputError(f"the map of {dive} has no views; map the dive again")
    return views, where
