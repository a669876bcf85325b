"""Pictures with their poses and the map's points, as programs that build maps take them in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.whole_folder import whole_folder
from aquaflow.dive.dive import Dive
from aquaflow.dive.png import write_png
from aquaflow.dive.point_cloud import PointCloud, read_splats
from aquaflow.dive.posed_views import PosedView, read_posed_views
from aquaflow.dive.recorded import recorded_pictures
from aquaflow.dive.restored import exposure_without_water, restored_frames
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.views import in_time

Progress = Callable[[int, int], None]
Pictures = Iterator[tuple[int, npt.NDArray[np.uint8]]]
"""Frame index and picture [H, W, 3] RGB, or [H, W, 4] RGBA where open water was removed."""
WriteModel = Callable[[Path, Sequence[PosedView], PointCloud], None]

IMAGES = "images"
"""Folder of the pictures, by the name that COLMAP, nerfstudio and OpenSplat look for."""


def picture_name(frame_index: int) -> str:
    """File name of the picture of a frame."""
    return f"{frame_index:06d}.png"


def export_posed_pictures(
    dive: Dive,
    out: Path,
    write_model: WriteModel,
    recording: Path | None,
    restored: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write the pictures of the dive's largest sub-map to ``out/images``, undistorted, and let
    ``write_model`` add cameras, poses and points; returns how many pictures there are.

    With ``restored`` pictures and points are without water; without a ``recording`` such pictures
    are drawn from the map.

    Raises:
        InputError: the dive has no map, the recording is missing or another, or a file cannot be
            written.
        ConfigError: the dive's settings cannot be read.
    """
    mapper = dive.map()
    views, where = read_posed_views(dive, mapper)
    cloud = PointCloud(read_splats(dive, where, water=not restored), views, where)
    pictures = (
        _without_water(dive, mapper, recording)
        if restored
        else _pictures_seen(dive, mapper, recording)
    )
    with whole_folder(out) as made:
        (made / IMAGES).mkdir()
        for done, (index, picture) in enumerate(pictures, start=1):
            write_png(made / IMAGES / picture_name(index), picture)
            if progress is not None:
                progress(done, len(views))
        write_model(made, views, cloud)
    return len(views)


def _pictures_seen(dive: Dive, mapper: Mapper, recording: Path | None) -> Pictures:
    if recording is None:
        raise InputError(
            f"{dive} holds no pictures of its own; add --recording with what was mapped, or "
            "--restored to have them drawn from the map"
        )
    pictures = recorded_pictures(dive, recording, in_time(mapper.views))
    return ((view.frame_index, picture) for view, picture in pictures)


def _without_water(dive: Dive, mapper: Mapper, recording: Path | None) -> Pictures:
    exposure = exposure_without_water(dive, mapper)
    frames = restored_frames(dive, mapper, recording)
    return ((index, picture.picture_bytes(exposure)) for index, picture in frames)
