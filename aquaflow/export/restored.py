"""The frames of a dive without their water, as pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.config import load_config
from aquaflow.errors import InputError
from aquaflow.export.map_file import SUFFIX, read_map_file
from aquaflow.export.png import write_png
from aquaflow.geometry.camera import load_camera
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import (
    RestoredPicture,
    common_exposure,
    drawn_without_water,
    restored_picture,
)
from aquaflow.mapping.views import View, in_time
from aquaflow.messages import Frame
from aquaflow.render import select_renderer
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation

LOOKS = 20
"""Frames, spread over the dive, that the common exposure is judged by."""

Progress = Callable[[int, int], None]


def export_restored(
    dive: Path, out: Path, recording: Path | None = None, progress: Progress | None = None
) -> int:
    """Write every mapped frame of the dive's largest sub-map to ``out``, as INDEX.png; how many.

    With the ``recording``, its pictures with the water taken out (J-hat of the paper), and as
    INDEX_confidence.png what share of each pixel was restored from the picture; without, the map
    from where they were taken: no noise and no fish, but no finer detail than the map's either.

    Raises:
        InputError: the dive has no map or no water, or the recording is another.
        ConfigError: the dive's settings cannot be read.
    """
    renderer = select_renderer(load_config(dive / "config.yaml").mapping.renderer)
    mapper = read_map_file(dive / f"map{SUFFIX}", renderer)
    if not mapper.medium.active:
        raise InputError(
            f"{dive} has no water to remove: it was found clear, or mapping.medium.enabled was off"
        )
    views = {view.frame_index: view for view in in_time(mapper.views)}
    shown = list(views.values())[:: max(1, len(views) // LOOKS)]
    with torch.no_grad():
        exposure = common_exposure(
            mapper.scene.balanced(mapper.show(view).radiance) for view in shown
        )
    out.mkdir(parents=True, exist_ok=True)
    count = 0
    for index, picture in _restored(dive, mapper, views, recording):
        write_png(out / f"{index:06d}.png", picture.picture_bytes(exposure))
        if recording is not None:
            write_png(out / f"{index:06d}_confidence.png", picture.confidence_bytes())
        count += 1
        if progress is not None:
            progress(count, len(views))
    return count


def _restored(
    dive: Path, mapper: Mapper, views: Mapping[int, View], recording: Path | None
) -> Iterator[tuple[int, RestoredPicture]]:
    """Frame index and restored picture."""
    if recording is None:
        for index, view in views.items():
            yield index, drawn_without_water(mapper.scene, mapper.show(view))
        return
    for index, image in _pictures(dive, recording, views):
        view = _with_picture(views[index], image)
        yield index, restored_picture(mapper.scene, view, mapper.show(view))


def _pictures(
    dive: Path, recording: Path, views: Mapping[int, View]
) -> Iterator[tuple[int, npt.NDArray[np.uint8]]]:
    """The frames of the views, prepared as the dive's were."""
    calibration = dive / "calibration.yaml"
    prepare = Preparation(
        load_config(dive / "config.yaml").source,
        load_camera(calibration) if calibration.is_file() else None,
    )
    indices = list(views)
    every = math.gcd(*(index - indices[0] for index in indices)) or 1
    source, missing = open_recording(recording), set(indices)
    try:
        for frame in source.frames(every, indices[0], indices[-1] + 1):
            if isinstance(frame, Frame) and frame.index in missing:
                missing.remove(frame.index)
                yield frame.index, prepare(frame).image
    finally:
        source.close()
    if missing:
        raise InputError(
            f"{recording} has no readable frame {min(missing)}, which {dive} mapped; give the "
            "recording that the dive was made from"
        )


def _with_picture(
    view: View,
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
) -> View:
    """``view``, whose pixels the map's file does not keep, with its picture."""
    size = (view.camera.height, view.camera.width)
    if image.shape[:2] != size:
        raise InputError(
            f"the recording's pictures are {image.shape[1]} x {image.shape[0]} once prepared, the "
            f"dive's {size[1]} x {size[0]}; give the recording that the dive was made from"
        )
    whole = View(
        view.frame_index, image, view.camera, view.T_wc, view.keyframe, view.robust,
        device=view.device,
    )  # fmt: skip
    whole.log_gain, whole.light = view.log_gain, view.light
    return whole
