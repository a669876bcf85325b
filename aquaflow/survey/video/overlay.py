"""Words in a video: a band below the picture, and a mark in its corner."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.survey.video.encoder import VideoEncoder

Picture = npt.NDArray[np.uint8]

LETTER_SHARE, LEAST_PX, MOST_PX = 1 / 36, 9, 40
"""Height of the letters over the picture's width, and its limits: the words of a line fit."""
SMALLEST_PX = 5
"""Letters below are no letters."""
LINE = 1.5
"""Height of a line over that of its letters."""
INK, GROUND, MARK = (235, 240, 245), (16, 20, 24), (255, 176, 32)
"""RGB."""


@cache
def _font(px: int) -> Any:
    return ImageFont.load_default(size=px)


def _letters(width: int) -> int:
    return round(min(max(width * LETTER_SHARE, LEAST_PX), MOST_PX))


def band(width: int, heads: Sequence[str], words: Sequence[str]) -> Picture:
    """[h, width, 3] two lines: ``heads``, each over the part of the width that it names, and
    ``words`` with equal gaps, in smaller letters where they would not fit."""
    px = _letters(width)
    height = round(px * LINE)
    image = Image.new("RGB", (width, 2 * height), GROUND)
    draw = ImageDraw.Draw(image)
    for number, head in enumerate(heads):
        draw.text((number * width // len(heads) + px // 2, px // 6), head, INK, _font(px))
    small = _fitting(words, px, width)
    lengths = [_font(small).getlength(word) for word in words]
    gap = (width - sum(lengths)) / max(len(words), 1)
    for number, word in enumerate(words):
        x = min(px // 2, gap / 2) + sum(lengths[:number]) + number * gap
        draw.text((x, height + px // 6), word, INK, _font(small))
    return np.asarray(image)


def _fitting(words: Sequence[str], px: int, room: int) -> int:
    """The height of letters, at most ``px``, at which the words fit with a letter in between."""
    wide = sum(_font(px).getlength(word) + px for word in words)
    return px if wide <= room else max(int(px * room / wide), SMALLEST_PX)


def mark(
    picture: Picture,  # [H, W, 3] RGB
    word: str,
) -> Picture:
    """The picture with ``word`` in its upper left corner."""
    px = max(_letters(picture.shape[1]) * 2 // 3, LEAST_PX)
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    width = int(_font(px).getlength(word))
    draw.rectangle((0, 0, width + px, round(px * LINE)), fill=GROUND)
    draw.text((px // 2, px // 6), word, MARK, _font(px))
    return np.asarray(image)


def words_of(t_s: float, known: PoseRow | None, north: str) -> list[str]:
    """Time, depth, heading and speed with their units, as far as the dive knows them; ``north`` is
    what the heading counts from."""
    minutes, seconds = divmod(round(t_s, 2), 60.0)
    words = [f"t {int(minutes)}:{seconds:05.2f}"]
    if known is None:
        return words
    if known.utc is not None:
        words[0] = f"{known.utc:%Y-%m-%d %H:%M:%S} UTC"
    if known.depth_m is not None:
        words.append(f"depth {known.depth_m:.2f} m")
    if known.heading_deg is not None:
        words.append(f"heading {known.heading_deg:.0f}\N{DEGREE SIGN} ({north})")
    if known.speed_m_s is not None:
        words.append(f"speed {known.speed_m_s:.2f} m/s")
    return words


# --------------------------------------------------------------------------------------------------
# Pictures at their own times in a video of a constant rate.


class Timeline:
    """Shows each picture from its time until the next one's, to half a picture's interval.

    Where two fall into one interval the later one is shown, so that times never drift.
    """

    def __init__(self, file: VideoEncoder, fps: float) -> None:
        self._file, self._fps = file, fps
        self._begun_s: float | None = None
        self._shown: tuple[int, Picture] | None = None

    def show(
        self,
        t_s: float,
        picture: Picture,  # [H, W, 3] RGB
    ) -> None:
        """The next picture; times are seconds and increase."""
        if self._begun_s is None:
            self._begun_s = t_s
        slot = round((t_s - self._begun_s) * self._fps)
        if self._shown is not None:
            before, last = self._shown
            for _ in range(slot - before):
                self._file.add(last)
        self._shown = slot, picture

    def end(self) -> None:
        """The last picture is shown for one interval."""
        if self._shown is not None:
            self._file.add(self._shown[1])


def usual_fps(
    t_s: npt.NDArray[np.float64],  # [N] increasing
    indices: npt.NDArray[np.intp],  # [N] increasing
) -> float:
    """Frames a second of a recording whose frames ``indices`` have the times ``t_s``: by the median
    interval, 1 for a single frame."""
    if len(t_s) < 2:
        return 1.0
    return float(1.0 / np.median(np.diff(t_s) / np.diff(indices)))
