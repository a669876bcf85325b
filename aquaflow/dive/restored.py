"""The frames of a dive without their water, as pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.errors import InputError
from aquaflow.base.storage.whole_folder import whole_folder
from aquaflow.dive.dive import Dive
from aquaflow.dive.png import write_png
from aquaflow.dive.recorded import recorded_pictures
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.rendering import RenderedMap
from aquaflow.mapping.restoration import (
    RestoredPicture,
    common_exposure,
    drawn_without_water,
    restored_picture,
)
from aquaflow.render.views import View, in_time

LOOKS = 20
"""Frames, spread over the dive, that the common exposure is judged by."""

Progress = Callable[[int, int], None]


def export_restored(
    dive: Dive, out: Path, recording: Path | None = None, progress: Progress | None = None
) -> int:
    """Write every mapped frame of the dive's largest sub-map to ``out``, as INDEX.png; how many.

    With the ``recording``, its pictures with the water taken out (J-hat of the paper), and as
    INDEX_confidence.png what share of each pixel was restored from the picture; without, the map
    from where they were taken: no noise and no fish, but no finer detail than the map's either.

    Raises:
        InputError: the dive has no map or no water, or the recording is another.
        ConfigError: the dive's settings cannot be read.
    """
    mapper = dive.map()
    exposure, count = exposure_without_water(dive, mapper), 0
    with whole_folder(out) as made:
        for index, picture in restored_frames(dive, mapper, recording):
            write_png(made / f"{index:06d}.png", picture.picture_bytes(exposure))
            if recording is not None:
                write_png(made / f"{index:06d}_confidence.png", picture.confidence_bytes())
            count += 1
            if progress is not None:
                progress(count, len(mapper.views))
    return count


def exposure_without_water(dive: Dive, mapper: Mapper) -> float:
    """The one gain of all restored pictures of ``dive``, whose map is ``mapper``.

    Raises:
        InputError: there is no water in the map.
    """
    if not mapper.medium.active:
        raise InputError(
            f"{dive} has no water to remove: it was found clear, or mapping.medium.enabled was off"
        )
    return exposure_of_looks(mapper)


@torch.no_grad()
def exposure_of_looks(mapper: Mapper) -> float:
    """The one gain at which the map's clean radiance is shown, judged by some of its views."""
    shown = in_time(mapper.views)[:: max(1, len(mapper.views) // LOOKS)]
    scene = mapper.scene
    return common_exposure(
        drawn_without_water(scene, view, mapper.show(view)).image for view in shown
    )


@dataclass(frozen=True)
class SeenFrame:
    """A mapped frame: as the camera saw it, and as the map shows it from there."""

    view: View
    """With its picture, if there is one."""
    picture: npt.NDArray[np.uint8] | None
    """[H, W, 3] RGB of the recording; None without one."""
    shown: RenderedMap


def seen_frames(dive: Dive, mapper: Mapper, recording: Path | None) -> Iterator[SeenFrame]:
    """Each mapped frame of ``dive``, whose map is ``mapper``, in the order of the recording.

    Raises:
        InputError: the recording is another than that of the dive.
    """
    views = in_time(mapper.views)
    if recording is None:
        for view in views:
            yield SeenFrame(view, None, mapper.show(view))
        return
    for view, picture in recorded_pictures(dive, recording, views):
        yield SeenFrame(_with_picture(view, picture), picture, mapper.show(view))


def without_water(mapper: Mapper, seen: SeenFrame) -> RestoredPicture:
    """The frame's picture restored; without a picture, the map as it would look."""
    if seen.picture is None:
        return drawn_without_water(mapper.scene, seen.view, seen.shown)
    return restored_picture(mapper.scene, seen.view, seen.shown)


def restored_frames(
    dive: Dive, mapper: Mapper, recording: Path | None
) -> Iterator[tuple[int, RestoredPicture]]:
    """Frame index and restored picture of each view, in the order of the recording; without a
    ``recording``, the map as it would look without water.

    Raises:
        InputError: the recording is another than that of the dive.
    """
    for seen in seen_frames(dive, mapper, recording):
        yield seen.view.frame_index, without_water(mapper, seen)


def _with_picture(
    view: View,
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
) -> View:
    """``view``, whose pixels the map's file does not keep, with its picture."""
    whole = View(
        view.frame_index, image, view.camera, view.T_wc, view.keyframe, view.robust,
        device=view.device,
    )  # fmt: skip
    whole.log_gain, whole.light = view.log_gain, view.light
    return whole
