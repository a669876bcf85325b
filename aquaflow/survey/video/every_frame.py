"""The pilot's video without its water, every frame of it: poses between tracked frames are
interpolated."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from aquaflow.base.errors import InputError
from aquaflow.dive.deliverables import FinishedFrame, read_finished_frames
from aquaflow.dive.dive import Dive
from aquaflow.dive.restored import (
    SeenFrame,
    preparation_of,
    seen_frames,
    tone_without_water,
    without_water,
)
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import to_bytes
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View, in_time
from aquaflow.sources import open_recording
from aquaflow.survey.video.encoder import check_name, video_file
from aquaflow.survey.video.overlay import Timeline, band, mark, usual_fps, words_of
from aquaflow.types import Frame

Progress = Callable[[int, int], None]

LONGEST_GAP_S = 1.0
"""Seconds between two poses that are interpolated: at a vehicle's 0.5 m/s and 20 deg/s the way in
between is nearly straight; over a longer gap it may have turned and come back."""
NO_POSE = "not restored: no pose"
"""Written into frames as the camera saw them."""


@dataclass(frozen=True)
class EveryFrame:
    """What was written."""

    frames: int
    restored: int


class CameraPoses:
    """Poses of the camera at any time of the dive, in the world of its map."""

    def __init__(self, frames: Sequence[FinishedFrame], T_nm: Sim3) -> None:
        posed = [(frame.t_ns, frame.T_nc) for frame in frames if frame.T_nc is not None]
        self._times = [t_ns for t_ns, _ in posed]
        T_mn = T_nm.inverse()
        self._poses = [_rigid(T_mn @ T_nc) for _, T_nc in posed]

    def at(self, t_ns: int) -> Sim3 | None:
        """The pose at a time, between its neighbours by slerp; None where those are too far apart,
        and before the first and after the last."""
        after = bisect_left(self._times, t_ns)
        if after < len(self._times) and self._times[after] == t_ns:
            return self._poses[after]
        if after in (0, len(self._times)):
            return None
        before, then = self._times[after - 1], self._times[after]
        if then - before > LONGEST_GAP_S * 1e9:
            return None
        share = (t_ns - before) / (then - before)
        first, second = self._poses[after - 1], self._poses[after]
        turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([first.R, second.R])))
        R = np.asarray(turns(share).as_matrix())
        return Sim3(R, (1.0 - share) * first.t + share * second.t)


def _rigid(T_mc: Sim3) -> Sim3:
    return Sim3(T_mc.R, T_mc.t)


def restore_every_frame(
    dive: Dive,
    path: Path,
    recording: Path,
    width: int | None = None,
    progress: Progress | None = None,
) -> EveryFrame:
    """Write the part of ``recording`` that was mapped with each of its frames restored, at its own
    time and rate, undistorted and ``width`` px wide (None: as mapped).

    A frame between two poses at most ``LONGEST_GAP_S`` apart has one in between, and exposure and
    light likewise; a frame without a pose is shown as it is, with a mark.

    Raises:
        InputError: the dive has no map or no water, the recording is another, or the file cannot be
            written.
        ConfigError: the dive's settings cannot be read.
    """
    check_name(path)
    mapper = dive.map()
    tone = tone_without_water(dive, mapper)
    frames = sorted(read_finished_frames(dive), key=lambda frame: frame.row.index)
    if not frames:
        raise InputError(f"{dive} has no frames; map the dive again")
    first, last = frames[0].row.index, frames[-1].row.index
    indices = np.array([frame.row.index for frame in frames])
    fps = usual_fps(np.array([frame.row.t_s for frame in frames]), indices)
    poses, light = CameraPoses(frames, dive.frame.T_nm), _Light(mapper)
    restored, count = 0, 0
    with video_file(path, fps) as file:
        timeline = Timeline(file, fps)
        for t_ns, frame in _read_frames(dive, recording, frames, width):
            T_wc, picture = poses.at(t_ns), frame.image
            if T_wc is None:
                picture = mark(picture, NO_POSE)
            else:
                view = light.view(frame, T_wc)
                seen = SeenFrame(view, picture, mapper.show(view))
                picture = without_water(mapper, seen).picture_bytes(tone)[..., :3]
                restored += 1
            timeline.show(t_ns * 1e-9, picture)
            count += 1
            if progress is not None:
                progress(frame.index - first + 1, last - first + 1)
        timeline.end()
    return EveryFrame(count, restored)


def _read_frames(
    dive: Dive, recording: Path, frames: Sequence[FinishedFrame], width: int | None
) -> Iterator[tuple[int, Frame]]:
    """Every frame of the mapped part with its time on the dive's clock (ns), prepared."""
    prepare, first, last = preparation_of(dive, width), frames[0], frames[-1]
    needed = {frame.row.index for frame in frames if frame.T_nc is not None}
    source = open_recording(recording)
    begun_ns: int | None = None
    try:
        for frame in source.frames(1, first.row.index, last.row.index + 1):
            if not isinstance(frame, Frame):
                continue
            if begun_ns is None:
                # Times of the dive count from its recording's first frame, and some clocks do not.
                begun_ns = frame.t_ns - _time_of(frames, frame.index)
            needed.discard(frame.index)
            yield frame.t_ns - begun_ns, prepare(frame)
    finally:
        source.close()
    if needed:
        raise InputError(
            f"{recording} has no readable frame {min(needed)}, which {dive} tracked; give the "
            "recording that the dive was made from"
        )


def _time_of(frames: Sequence[FinishedFrame], index: int) -> int:
    """When a frame was, ns: linear between those of the table."""
    known = [frame.row.index for frame in frames], [frame.t_ns for frame in frames]
    return round(float(np.interp(index, *known)))


class _Light:
    """What the map learned of the light in its views, for the frames in between."""

    def __init__(self, mapper: Mapper) -> None:
        self._views = in_time(mapper.views)
        self._indices = [view.frame_index for view in self._views]

    def view(self, frame: Frame, T_wc: Sim3) -> View:
        """A view of ``frame`` with the exposure and the light between those of its neighbours."""
        after = bisect_left(self._indices, frame.index)
        one = self._views[max(after - 1, 0)]
        two = self._views[min(after, len(self._views) - 1)]
        span = two.frame_index - one.frame_index
        share = (frame.index - one.frame_index) / span if span else 0.0
        height, width = frame.image.shape[:2]
        view = View(
            frame.index, frame.image, one.camera.resize(width, height), T_wc, one.keyframe, False,
            frame.mask, one.device,
        )  # fmt: skip
        view.log_gain = (1.0 - share) * one.log_gain + share * two.log_gain
        if one.light is not None and two.light is not None:
            view.light = (1.0 - share) * one.light + share * two.light
        return view


# --------------------------------------------------------------------------------------------------
# Camera and scene without water side by side, with what the dive knows below.

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
    tone = tone_without_water(dive, mapper)
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
            clear = without_water(mapper, seen).picture_bytes(tone)[..., :3]
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
