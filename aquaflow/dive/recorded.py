"""The recording's pictures of a dive's views, prepared as they were mapped."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.geometry.camera import CameraModel
from aquaflow.render.views import View
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame


def recorded_pictures(
    dive: Dive, recording: Path, views: Sequence[View]
) -> Iterator[tuple[View, npt.NDArray[np.uint8]]]:
    """Each of ``views``, which are in the order of the recording, with its picture [H, W, 3] RGB:
    cropped, undistorted by the dive's camera and resized.

    Raises:
        InputError: the recording has not all of the frames, or has them in another size.
        ConfigError: the dive's settings or its calibration cannot be read.
    """
    prepare = preparation_of(dive)
    missing = {view.frame_index: view for view in views}
    indices = list(missing)
    every = math.gcd(*(index - indices[0] for index in indices)) or 1
    source = open_recording(recording)
    try:
        for frame in source.frames(every, indices[0], indices[-1] + 1):
            if isinstance(frame, Frame) and frame.index in missing:
                view = missing.pop(frame.index)
                picture = prepare(frame).image
                _check_size(recording, picture, view.camera)
                yield view, picture
    finally:
        source.close()
    if missing:
        raise InputError(
            f"{recording} has no readable frame {min(missing)}, which {dive} mapped; give the "
            "recording that the dive was made from"
        )


def preparation_of(dive: Dive, width: int | None = None) -> Preparation:
    """How the pictures of ``dive`` were prepared: cropped, undistorted and resized, to ``width``
    pixels in place of what was mapped.

    Raises:
        InputError, ConfigError: the dive's settings or its calibration cannot be read.
    """
    source = dive.config.source
    if width is not None:
        source = source.model_copy(update={"width": width})
    return Preparation(source, dive.calibration)


def _check_size(
    recording: Path,
    picture: npt.NDArray[np.uint8],  # [H, W, 3]
    camera: CameraModel,
) -> None:
    height, width = picture.shape[:2]
    if (height, width) != (camera.height, camera.width):
        raise InputError(
            f"the pictures of {recording} are {width} x {height} once prepared, the dive's "
            f"{camera.width} x {camera.height}; give the recording that the dive was made from"
        )
