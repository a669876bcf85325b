"""How a picture becomes a network's input of another size, and what of the output shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]
Scalar = TypeVar("Scalar", bound=np.generic)

GREY = 127
"""Of what lies around a picture: the middle of the scale, and nothing after normalisation."""


@dataclass(frozen=True)
class ImagePadding:
    """A picture inside a larger one of fixed size: whole, and not stretched.

    Its sides there are whole cells of the network, so that the cells that show it cover it evenly;
    what lies around it is cut off from every output.
    """

    frame_height: int
    """px, as are all"""
    frame_width: int
    top: int
    left: int
    height: int
    width: int

    @staticmethod
    def of(height: int, width: int, frame: tuple[int, int], cell_px: int) -> ImagePadding:
        """Of a picture of ``height`` x ``width`` px in the middle of a ``frame`` (height, width),
        as large as fits."""
        scale = min(frame[0] / height, frame[1] / width)
        inner = [
            min(max(round(scale * side / cell_px), 1), available // cell_px) * cell_px
            for side, available in zip((height, width), frame, strict=True)
        ]
        before = [
            (available - side) // 2 // cell_px * cell_px
            for side, available in zip(inner, frame, strict=True)
        ]
        return ImagePadding(*frame, *before, *inner)

    def frame(
        self,
        image: Picture,  # [H, W, 3]
    ) -> Picture:
        """[frame_height, frame_width, 3]"""
        framed = np.full((self.frame_height, self.frame_width, 3), GREY, np.uint8)
        inside = resize(image, self.height, self.width)
        framed[self.top : self.top + self.height, self.left : self.left + self.width] = inside
        return framed

    def cut(
        self,
        field: npt.NDArray[Scalar],  # [h, w, ...] covers the frame evenly
    ) -> npt.NDArray[Scalar]:
        """[h', w', ...] what of it shows the picture."""
        down, across = field.shape[0] / self.frame_height, field.shape[1] / self.frame_width
        rows = slice(round(self.top * down), round((self.top + self.height) * down))
        columns = slice(round(self.left * across), round((self.left + self.width) * across))
        return field[rows, columns]


def as_input(
    picture: Picture,  # [h, w, 3]
) -> npt.NDArray[np.float32]:
    """[1, 3, h, w] in [0, 1]"""
    return np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=np.float32) / 255.0


def resize(
    image: Picture,  # [H, W, 3]
    height: int,
    width: int,
) -> Picture:
    """[height, width, 3]; pixels are averaged where it becomes smaller."""
    if image.shape[:2] == (height, width):
        return image
    shrinks = height < image.shape[0]
    way = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=way), dtype=np.uint8)


def multiple_of(side: float, step: int) -> int:
    """The multiple of ``step`` next to ``side``; at least one."""
    return max(step, round(side / step) * step)
