"""Camera and scene without water side by side, with what the dive knows below."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.deliverables import FinishedFrame, read_finished_frames
from aquaflow.dive.dive import Dive
from aquaflow.dive.restored import exposure_without_water, seen_frames, without_water
from aquaflow.mapping.restoration import to_bytes
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import in_time
from aquaflow.survey.video.encoder import check_name, video_file
from aquaflow.survey.video.overlay import band, words_of
from aquaflow.survey.video.timeline import Timeline, usual_fps

Progress = Callable[[int, int], None]

LEAST_FPS, MOST_FPS = 1.0, 60.0
"""Of the video: a player shows nothing sensible beyond."""


def side_by_side(
    dive: Dive, path: Path, recording: Path | None = None, progress: Progress | None = None
) -> int:
    """Write the mapped frames of the largest sub-map, each at its own time; how many there are.

    On the left the camera's picture, or without a ``recording`` the map through its water; on the
    right the same without water; below time, depth, heading and speed where they are known.

    Raises:
        InputError: the dive has no map or no water, the recording is another, or the file cannot be
            written.
        ConfigError: the dive's settings cannot be read.
    """
    check_name(path)
    mapper = dive.map()
    exposure = exposure_without_water(dive, mapper)
    frames = _by_index(read_finished_frames(dive))
    shown = [view.frame_index for view in in_time(mapper.views)]
    if not shown or any(index not in frames for index in shown):
        raise InputError(f"frames.csv of {dive} lacks frames of its map; map the dive again")
    times = np.array([frames[index].row.t_s for index in shown])
    # Of the frames that were mapped: what lies between repeats the one before.
    fps = float(np.clip(usual_fps(times, np.arange(len(shown))), LEAST_FPS, MOST_FPS))
    north = dive.frame.north
    left = "map, through the water" if recording is None else "camera"
    with video_file(path, fps) as file:
        timeline = Timeline(file, fps)
        for done, seen in enumerate(seen_frames(dive, mapper, recording), start=1):
            frame = frames[seen.view.frame_index]
            picture = seen.picture
            if picture is None:
                picture = to_bytes(picture_out(seen.shown.image))
            clear = without_water(mapper, seen).picture_bytes(exposure)[..., :3]
            words = words_of(frame.row.t_s, frame.known, north)
            timeline.show(frame.row.t_s, _compose(picture, clear, left, words))
            if progress is not None:
                progress(done, len(shown))
        timeline.end()
    return len(shown)


def _by_index(frames: list[FinishedFrame]) -> dict[int, FinishedFrame]:
    return {frame.row.index: frame for frame in frames}


def _compose(
    picture: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    clear: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    left: str,
    words: list[str],
) -> npt.NDArray[np.uint8]:
    """[H + h, 2 W, 3] both pictures over a band of words."""
    pictures = np.hstack([picture, clear])
    return np.vstack([pictures, band(pictures.shape[1], [left, "without water"], words)])
