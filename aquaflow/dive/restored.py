"""The pictures of a dive: without their water, as they were recorded, and with poses and points."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.whole_folder import whole_folder
from aquaflow.dive.dive import Dive
from aquaflow.dive.picture_exif import exif_of_views
from aquaflow.dive.png import write_png
from aquaflow.dive.point_cloud import PointCloud, PosedView, read_posed_views, read_splats
from aquaflow.geometry.camera import CameraModel
from aquaflow.mapping.appearance import shown_tone
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import (
    RestoredPicture,
    drawn_without_water,
    restored_picture,
)
from aquaflow.mapping.scene import RenderedMap
from aquaflow.render.views import View, in_time
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame
from aquaflow.water.tone import ShownTone

Progress = Callable[[int, int], None]


def export_restored(
    dive: Dive, out: Path, recording: Path | None = None, progress: Progress | None = None
) -> int:
    """Write every mapped frame of the dive's largest sub-map to ``out``, as INDEX.png; how many.

    With the ``recording``, its pictures with the water taken out (J-hat of the paper), and as
    INDEX_confidence.png what share of each pixel was restored from the picture; without, the map
    from where they were taken: no noise and no fish, but no finer detail than the map's either.
    Pictures of a dive on the earth say in EXIF where and when they were taken.

    Raises:
        InputError: the dive has no map or no water, or the recording is another.
        ConfigError: the dive's settings cannot be read.
    """
    mapper = dive.map()
    tone, count = tone_without_water(dive, mapper), 0
    exif = exif_of_views(dive, mapper.views)
    with whole_folder(out) as made:
        for index, picture in restored_frames(dive, mapper, recording):
            write_png(made / f"{index:06d}.png", picture.picture_bytes(tone), exif.get(index))
            if recording is not None:
                write_png(made / f"{index:06d}_confidence.png", picture.confidence_bytes())
            count += 1
            if progress is not None:
                progress(count, len(mapper.views))
    return count


def tone_without_water(dive: Dive, mapper: Mapper) -> ShownTone:
    """What all restored pictures of ``dive``, whose map is ``mapper``, are shown in.

    Raises:
        InputError: there is no water in the map.
    """
    refuse_without_water(dive, mapper)
    return shown_tone(mapper)


def refuse_without_water(dive: Dive, mapper: Mapper) -> None:
    """Raises InputError where ``mapper``, the map of ``dive``, has no water."""
    if not mapper.medium.active:
        raise InputError(
            f"{dive} has no water to remove: it was found clear, or mapping.medium.enabled was off"
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
        yield SeenFrame(with_picture(view, picture), picture, mapper.show(view))


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


def with_picture(
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


def view_of_frame(mapper: Mapper, frame: int, dive: Dive) -> View:
    """The view of a frame.

    Raises:
        InputError: the frame was not mapped.
    """
    views = {view.frame_index: view for view in mapper.views}
    if frame not in views:
        nearest = min(views, key=lambda index: abs(index - frame), default=None)
        other = "" if nearest is None else f"; the nearest mapped one is {nearest}"
        raise InputError(f"frame {frame} of {dive} was not mapped{other}")
    return views[frame]


def refuse_outside(
    view: View,
    pixels: npt.NDArray[np.float64],  # [N, 2] px
) -> None:
    """Raises InputError for pixels that the mapped picture does not have."""
    size = np.array([view.camera.width, view.camera.height])
    for pixel in pixels:
        if not bool(np.all((pixel >= 0.0) & (pixel < size))):
            raise InputError(
                f"the point {pixel[0]:g},{pixel[1]:g} is outside of the mapped picture of "
                f"{size[0]} x {size[1]} pixels; give pixels of the pictures that `aquaflow export "
                "--format restored` writes"
            )


# --------------------------------------------------------------------------------------------------
# The recording's pictures of a dive's views, prepared as they were mapped.


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


# --------------------------------------------------------------------------------------------------
# Pictures with their poses and the map's points, as programs that build maps take them in.

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
    are drawn from the map. Of a dive on the earth they say in EXIF where and when they were taken.

    Raises:
        InputError: the dive has no map, the recording is missing or another, or a file cannot be
            written.
        ConfigError: the dive's settings cannot be read.
    """
    mapper = dive.map()
    views, where = read_posed_views(dive, mapper.views)
    exif = exif_of_views(dive, mapper.views)
    cloud = PointCloud(read_splats(dive, where, water=not restored), views, where)
    pictures = (
        _without_water(dive, mapper, recording)
        if restored
        else _pictures_seen(dive, mapper, recording)
    )
    with whole_folder(out) as made:
        (made / IMAGES).mkdir()
        for done, (index, picture) in enumerate(pictures, start=1):
            write_png(made / IMAGES / picture_name(index), picture, exif.get(index))
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
    tone = tone_without_water(dive, mapper)
    frames = restored_frames(dive, mapper, recording)
    return ((index, picture.picture_bytes(tone)) for index, picture in frames)
