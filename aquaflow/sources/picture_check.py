"""What is odd about pictures before they are mapped, in words for the user."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import times
from aquaflow.config import SourceConfig
from aquaflow.sources import CameraSource
from aquaflow.types import Frame

Grey: TypeAlias = npt.NDArray[np.float32]
"""[H, W] green of every few pixels."""
GREEN = 1
"""Channel that water lets through."""
FIRST = 10
"""Pictures that are looked at before a recording is mapped: 0.1 s of a film's decoding."""
STEP = 8
"""Every 8th pixel of every 8th row is looked at."""
FLAT = 1.0
"""Grey levels of standard deviation; noise of an 8-bit camera in the dark has as much."""
DARK, BRIGHT = 8.0, 247.0
"""Mean grey levels of near-black and near-white pictures."""
CUT = 0.2
"""Correlation with the next picture, below which the scene is another."""
STILL = 0.5
"""Mean difference, grey levels, between the first and any other, up to which nothing moves."""
MOST_SHARE = 0.5
"""Share of the pictures from which on something is said of them."""


class PictureCheck:
    """What is odd about pictures that follow each other; each is looked at once and forgotten."""

    def __init__(self) -> None:
        self._count = self._dark = self._bright = self._flat = self._repeated = self._cuts = 0
        self._first: Grey | None = None
        self._last: Grey | None = None
        self._whole = np.empty((0, 0, 3), np.uint8)
        """The last picture, for the few that equal it where it is looked at."""
        self._moved = 0.0
        """Mean difference to the first picture, the largest."""

    def add(
        self,
        picture: npt.NDArray[np.uint8],  # [H, W, 3]
    ) -> None:
        """The next picture; one of another size than the first is not looked at."""
        grey = picture[::STEP, ::STEP, GREEN].astype(np.float32)
        if self._first is None or self._last is None:
            self._first = self._last = grey
        if grey.shape != self._first.shape:
            return
        mean = float(grey.mean())
        self._count += 1
        self._dark += mean < DARK
        self._bright += mean > BRIGHT
        self._flat += float(grey.std()) < FLAT
        if self._count > 1:
            same = np.array_equal(grey, self._last)
            self._repeated += same and np.array_equal(picture, self._whole)
            self._cuts += _correlation(self._last, grey) < CUT
            self._moved = max(self._moved, float(np.abs(grey - self._first).mean()))
        self._last, self._whole = grey, picture

    def blank(self) -> list[str]:
        """Clauses on pictures without a scene."""
        return [
            f"{number} of {self._count} pictures are {words}"
            for number, words in (
                (self._dark, "nearly black"),
                (self._bright, "nearly white"),
                (self._flat, "of one colour"),
            )
            if number > MOST_SHARE * self._count
        ]

    def oddities(self) -> list[str]:
        """Clauses on the pictures so far; none for usual ones."""
        count, said = self._count, self.blank()
        if self._flat > MOST_SHARE * count or count < 2:
            return said
        if self._moved < STILL:
            said.append("nothing moves: all pictures show the same")
        elif self._repeated > MOST_SHARE * (count - 1):
            said.append(f"{self._repeated} of {count} pictures repeat the one before")
        if 0 < self._cuts <= MOST_SHARE * (count - 1):  # stills of a survey are all unlike
            said.append(f"the scene changes from one picture to the next {times(self._cuts)}")
        return said


def blank_at_first(camera: CameraSource, source: SourceConfig) -> list[str]:
    """Clauses on the first pictures that would be mapped, if they show no scene: whether anything
    moves is too early to say."""
    check = PictureCheck()
    frames = camera.frames(source.every, source.start, source.stop)
    for frame in islice(frames, FIRST):
        if isinstance(frame, Frame):
            check.add(frame.image)
    return check.blank()


def oddities(
    pictures: Sequence[npt.NDArray[np.uint8]],  # [H, W, 3] each
) -> list[str]:
    """Clauses on pictures that follow each other; none for usual ones."""
    check = PictureCheck()
    for picture in pictures:
        check.add(picture)
    return check.oddities()


def _correlation(
    a: Grey,  # [h, w]
    b: Grey,  # [h, w]
) -> float:
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a * a).mean() * (b * b).mean()))
    return 1.0 if spread < FLAT * FLAT else float((a * b).mean()) / spread
