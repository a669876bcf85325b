"""A video file that browsers play, written whole or not at all.

VP9 in MP4. OpenCV's wheels encode by an FFmpeg of LGPL parts and libvpx (BSD) alone: they have
neither x264 nor x265, which are GPL, and so no H.264. They take no settings of the encoder, and
write no sound.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.base.storage.atomic import fresh_file

SUFFIX, CODEC = ".mp4", "vp09"
"""Of the files; the codec by its FourCC."""
MOST_FPS = 240.0
"""Pictures a second; no camera of a vehicle has more."""


class VideoEncoder:
    """Appends pictures of one size."""

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, fps
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self.count = 0
        """Pictures so far."""

    def add(
        self,
        picture: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    ) -> None:
        """Append a picture; a last row or column is doubled where the number is odd.

        Raises:
            InputError: the file cannot be written.
            ValueError: it has another size than the first.
        """
        height, width = picture.shape[:2]
        odd = ((0, height % 2), (0, width % 2), (0, 0))  # colours have half the resolution
        whole = np.pad(picture, odd, mode="edge")
        if self._writer is None:
            self._size = (whole.shape[1], whole.shape[0])
            self._writer = self._open_writer()
        if (whole.shape[1], whole.shape[0]) != self._size:
            raise ValueError(f"a picture of {width} x {height} in a video of {self._size}")
        self._writer.write(np.ascontiguousarray(whole[..., ::-1]))
        self.count += 1

    def _open_writer(self) -> cv2.VideoWriter:
        code = cv2.VideoWriter.fourcc(*CODEC)
        writer = cv2.VideoWriter(str(self._path), cv2.CAP_FFMPEG, code, self._fps, self._size)
        if not writer.isOpened():
            raise InputError(
                f"OpenCV cannot write VP9 video to {self._path.parent}; give another "
                "--out, or install opencv-contrib-python-headless from PyPI"
            )
        return writer

    def finish(self) -> None:
        """End the file; nothing was lost if this returns.

        Raises:
            InputError: the file is not whole, as on a full disk.
        """
        if self._writer is None:
            raise InputError("there is no picture to make a video of; map the dive again")
        self._writer.release()
        reader = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        found = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
        reader.release()
        if found != self.count:
            raise InputError(
                f"only {found} of {self.count} pictures are in {self._path.parent}; give a folder "
                "with more room"
            )

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._writer is not None:
            self._writer.release()


def check_name(path: Path) -> None:
    """Before anything is drawn for it.

    Raises:
        ArgumentError: the file would have another ending than AquaFlow writes.
    """
    if path.suffix.lower() != SUFFIX:
        raise ArgumentError(f"{path} must end in {SUFFIX}: AquaFlow writes VP9 in MP4")


@contextlib.contextmanager
def video_file(path: Path, fps: float) -> Iterator[VideoEncoder]:
    """A video that becomes ``path`` when the block ends without an exception.

    Raises:
        InputError: the name has another ending, or the file cannot be written.
    """
    check_name(path)
    with fresh_file(path) as part:  # FFmpeg takes the container from the ending
        file = VideoEncoder(part, min(fps, MOST_FPS))
        try:
            yield file
            file.finish()
        except BaseException:
            file.abandon()
            raise
