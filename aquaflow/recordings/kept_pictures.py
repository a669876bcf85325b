"""``pictures/NNNNNN.jpg``: small pictures of what the camera saw, by the frame's index.

One a second at first. Where all of them take more than the dive may spend, every second one is
removed and half as many are kept from then on, so that they always span the whole dive.
"""

from __future__ import annotations

import contextlib
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.base.storage.atomic import atomic_write, make_subfolder
from aquaflow.sources.newest import Newest
from aquaflow.types import Frame

FOLDER = "pictures"
"""In a dive's folder (docs/formats.md#pictures)."""
LONGEST_SIDE = 480
"""px: 15 to 50 kB as JPEG, and as large as half of a tablet shows it."""
QUALITY = 80
"""Of JPEG; artefacts begin to show below."""
SPACING_S = 1.0
"""Between two pictures at first: at 0.5 m/s and 2 m altitude they overlap by 80 %."""
FEWEST = 2
"""Pictures that are never thinned: the first and one more."""
LOOK_S = 0.5
"""Longest wait for a picture; then the thread checks whether it shall end."""


class KeptPictures:
    """For one thread at a time; :class:`PictureThread` for a live dive."""

    def __init__(self, dive: Path, most_bytes: float) -> None:
        """Goes on with what ``dive`` holds already."""
        self._folder, self._most = dive / FOLDER, most_bytes
        self._sizes = dict(sorted(_sizes(self._folder).items()))
        self.paths = self._paths()
        """By the frame's index; replaced whenever it changes."""
        self._spacing_s, self._next_ns = SPACING_S, -(1 << 62)

    @property
    def taken(self) -> int:
        """Bytes of all pictures."""
        return sum(self._sizes.values())

    def is_due(self, t_ns: int) -> bool:
        """True if the picture of that moment is to be kept."""
        return t_ns >= self._next_ns

    def offer(self, frame: Frame) -> None:
        """Keep the picture if it is due.

        Raises:
            InputError: it cannot be written; the next one is tried in its turn.
        """
        if not self.is_due(frame.t_ns):
            return
        self._next_ns = frame.t_ns + round(1e9 * self._spacing_s)
        data = encode(frame)
        try:
            make_subfolder(self._folder)
        except OSError as error:
            raise InputError(f"cannot make {self._folder}: {error.strerror}") from error
        with atomic_write(self._folder / _name(frame.index)) as stream:
            stream.write(data)
        self._sizes[frame.index] = len(data)
        while self.taken > self._most and len(self._sizes) > FEWEST:
            self._thin()
        self.paths = self._paths()

    def _paths(self) -> dict[int, Path]:
        return {index: self._folder / _name(index) for index in self._sizes}

    def _thin(self) -> None:
        self._spacing_s *= 2.0
        for index in list(self._sizes)[1::2]:
            with contextlib.suppress(OSError):
                (self._folder / _name(index)).unlink(missing_ok=True)
            del self._sizes[index]


class PictureThread:
    """Keeps pictures of a live dive: tracking never waits for the disk."""

    def __init__(
        self, kept: KeptPictures, failures: Failures, has_room: Callable[[], bool] = lambda: True
    ) -> None:
        """``has_room``: False where the disk is kept for what matters more."""
        self._kept, self._failures, self._has_room = kept, failures, has_room
        self._frames: Newest[Frame] = Newest()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)
        self._thread.start()

    def offer(self, frame: Frame) -> None:
        """In tracking's thread; a picture that comes before the last one is written replaces it."""
        if self._kept.is_due(frame.t_ns) and self._has_room():
            self._frames.put(frame)

    def close(self) -> None:
        """Write what waits, and end the thread."""
        self._closing.set()
        self._frames.end()
        self._thread.join(5.0)

    def _run(self) -> None:
        while not (self._closing.is_set() and self._frames.ended):
            frame = self._frames.take(LOOK_S)
            if frame is not None:
                with self._failures.contain("keeping of a picture", full_disk=True):
                    self._kept.offer(frame)


def kept_pictures(dive: Path) -> dict[int, Path]:
    """The pictures of a dive by the frame's index, in order; those of a moment."""
    return {index: dive / FOLDER / _name(index) for index in sorted(_sizes(dive / FOLDER))}


def encode(frame: Frame) -> bytes:
    """A JPEG file of the frame's picture, at most ``LONGEST_SIDE`` long."""
    import cv2

    image = frame.image
    height, width = image.shape[:2]
    share = LONGEST_SIDE / max(height, width)
    if share < 1.0:
        size = (max(1, round(share * width)), max(1, round(share * height)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done  # of three channels of bytes it always is
    return bytes(data)


def _name(index: int) -> str:
    return f"{index:06d}.jpg"


def _sizes(folder: Path) -> dict[int, int]:
    """Bytes by index; what another name has is no picture of ours."""
    found = {}
    with contextlib.suppress(OSError):
        for path in () if folder.is_symlink() else folder.iterdir():
            if path.suffix == ".jpg" and path.stem.isascii() and path.stem.isdecimal():
                state = path.lstat()
                if stat.S_ISREG(state.st_mode):
                    found[int(path.stem)] = state.st_size
    return found
