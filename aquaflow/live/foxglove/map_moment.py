"""What Foxglove shows of a map, taken in the mapping thread and turned into messages elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.dive.placement import placement
from aquaflow.dive.ply import PlyGaussians
from aquaflow.dive.point_cloud import PointCloud, PosedView, posed_views
from aquaflow.dive.restored import SeenFrame, without_water
from aquaflow.dive.ros import messages
from aquaflow.mapping.appearance import seen_and_clear
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import restored_own, to_bytes
from aquaflow.mapping.state import MapCopy, copy_map
from aquaflow.render.transfers import picture_out
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.medium import WaterParameters
from aquaflow.water.tone import tone_of

Picture = npt.NDArray[np.uint8]

MOST_VIEWS = 64
"""Cameras that points look for the nearest of, evenly over the dive: some milliseconds."""


@dataclass(frozen=True)
class MapMoment:
    """Copies of a map as it was, and its newest view."""

    sub_map: int
    copy: MapCopy | None
    """None where nobody looks at points."""
    views: list[PosedView]
    """In the upright frame of ``frame``."""
    frame: WorldFrame
    frame_index: int
    """Of the newest view, whose pictures follow."""
    rendered: Picture | None
    restored: Picture | None
    water: WaterParameters | None


@torch.no_grad()
def take_map_moment(
    mapper: Mapper, sub_map: int, frame: WorldFrame, points: bool, pictures: bool
) -> MapMoment:
    """In the mapping thread: copies for ``points``, and ``pictures`` of the newest view; as long as
    one step of the optimiser."""
    step = max(1, len(mapper.views) // MOST_VIEWS)
    views = posed_views(mapper.views[::step], frame, placement(frame)) if points else []
    view, rendered, restored = mapper.views[-1], None, None
    if pictures:
        seen = SeenFrame(view, view.image, mapper.show(view))
        rendered = to_bytes(picture_out(seen.shown.image))
        if mapper.medium.active:
            own = restored_own(mapper.scene, view, seen.shown)
            tone = tone_of(*seen_and_clear(view, seen.shown, own))
            restored = without_water(mapper, seen).picture_bytes(tone)[..., :3]
    water = mapper.scene.water(view)
    copy = copy_map(mapper) if points else None
    return MapMoment(sub_map, copy, views, frame, view.frame_index, rendered, restored, water)


def cloud_of(moment: MapMoment, budget: int) -> npt.NDArray[np.void] | None:
    """[N] records of points in the frame ``map``, at most ``budget``; None without a copy."""
    if moment.copy is None:
        return None
    plain = moment.copy.parameters
    with np.errstate(over="ignore"):
        opacities = 1.0 / (1.0 + np.exp(-plain["opacity_logits"][:, 0]))
        scales = np.exp(plain["log_scales"])
    splats = PlyGaussians(plain["means"], plain["quats"], scales, opacities, moment.copy.clear)
    where = placement(moment.frame)
    upright = splats.transform(moment.frame.T_nm).transform(where.T_un)
    points = messages.packed_points(PointCloud(upright, moment.views, where))
    return points[:: -(-len(points) // budget)] if len(points) else points


def water_status(water: WaterParameters | None, frame: WorldFrame) -> Any:
    """diagnostic_msgs/DiagnosticStatus with the parameters of the image formation; rates per metre,
    or per map unit."""
    name = "aquaflow: water"
    if water is None:
        return messages.status(messages.OK, name, "no water is modelled", {})
    per = "1/m" if frame.metric else "1/map unit"
    rates = {"attenuation": water.beta_a, "b": water.b, "d": water.d}
    values: dict[str, object] = {}
    for key, tensor in rates.items():
        for channel, value in zip(messages.CHANNELS, picture_out(tensor), strict=True):
            values[f"{key} {channel}, {per}"] = f"{value / frame.T_nm.scale:.6g}"
    for key, tensor in {"B_inf": water.B_inf, "B_res": water.B_res}.items():
        for channel, value in zip(messages.CHANNELS, picture_out(tensor), strict=True):
            values[f"{key} {channel}"] = f"{value:.6g}"
    lamp = water.lamp and water.lamp.rescale(frame.T_nm.scale)
    values |= messages.lamp_values(lamp, per.removeprefix("1/"))
    return messages.status(messages.OK, name, "parameters of the image formation", values)
