"""Laser dots in a picture: small, bright, and of the laser's colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

CHANNEL = {"red": 0, "green": 1, "blue": 2}
LEAST_CHROMA = 40
"""Grey levels by which the colour stands out of the other two around a dot: more than any sea floor
does over a few pixels (judgement)."""
LEAST_PEAK = 200
"""Grey levels of the colour in the dot, which is far brighter than what it falls on."""
LEAST_AREA_PX = 4
LARGEST_SHARE = 2e-3
"""Of the picture's pixels: a dot of 25 px radius at 1280 x 720."""
LEAST_FILL = 0.5
"""Area over that of the box around; a disc has 0.79."""
LONGEST = 3.0
"""Length over width of the box: a dot on a slope is an ellipse."""
CORE_PX = 5
"""Closes the white core of a dot that saturates all three channels."""
MOST_DOTS = 12
"""Candidates of one picture; the brightest are kept."""


@dataclass(frozen=True)
class DotCandidates:
    """What may be laser dots in one picture."""

    frame_index: int
    pixels: Array
    """[N, 2] centres, brightest first."""


def find_dots(
    frame_index: int,
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    colour: Literal["red", "green", "blue"],
) -> DotCandidates:
    """Spots of the colour, each to a fraction of a pixel."""
    channel = CHANNEL[colour]
    own = image[..., channel]
    others = np.max(np.delete(image, channel, axis=2), axis=2)
    coloured = cv2.subtract(own, np.ascontiguousarray(others)) > LEAST_CHROMA
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CORE_PX, CORE_PX))
    spots = cv2.morphologyEx(coloured.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(spots)
    found: list[tuple[float, Array]] = []
    for label in range(1, count):
        x, y, w, h, area = (int(each) for each in boxes[label])
        if not _is_dot(w, h, area, own.size):
            continue
        inside = labels[y : y + h, x : x + w] == label
        bright = np.where(inside, own[y : y + h, x : x + w], 0).astype(np.float64)
        if bright.max() >= LEAST_PEAK:
            found.append((float(bright.sum()), _centre(bright) + np.array([x, y])))
    found.sort(key=lambda each: -each[0])
    centres = [centre for _, centre in found[:MOST_DOTS]]
    return DotCandidates(frame_index, np.array(centres, np.float64).reshape(-1, 2))


def _is_dot(w: int, h: int, area: int, pixels: int) -> bool:
    compact = area >= LEAST_FILL * w * h and max(w, h) <= LONGEST * min(w, h)
    return compact and LEAST_AREA_PX <= area <= LARGEST_SHARE * pixels


def _centre(
    bright: Array,  # [h, w]
) -> Array:
    """[2] the centre of the light, px from the corner of the box."""
    rows, columns = np.indices(bright.shape) + 0.5
    total = float(bright.sum())
    return np.array([float((columns * bright).sum()), float((rows * bright).sum())]) / total
