"""Text and lines that the recorder burns in: they stay where they are while the scene moves.

Their pixels show nothing of the scene and are marked as not valid in both views.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pairs import Pair, ViewBatch

CHARACTERS = "0123456789:./-+ ABCDEFGHKMNPRSTXYdeghmnprst"
"""Of clocks, depths, headings and names."""
LINES = 4
"""Of text, at most."""
LONGEST = 14
"""Characters of a line of text."""
SCALE = (0.22, 0.5)
"""Of the font: capital letters of 5 to 11 px."""
CHANGING = 2
"""Last characters of a line that may differ between the two pictures: seconds, decimeters."""
SEE_THROUGH = (0.6, 1.0)
"""Opacity."""


def with_overlay(draw: Draw, pair: Pair) -> Pair:
    """The pair with one overlay per item; after the sensor."""
    drawn = [_draw(draw, *pair.a.depth.shape[-2:]) for _ in range(len(pair.a.K))]
    colour = draw.chance(0.7, len(drawn), 1, 1, 1).float()  # white, or black
    opacity = draw.uniform(len(drawn), 1, 1, 1, low=SEE_THROUGH[0], high=SEE_THROUGH[1])
    views = []
    for view, index in zip((pair.a, pair.b), (0, 1), strict=True):
        ink = torch.from_numpy(np.stack([both[index] for both in drawn])).to(draw.device)
        views.append(_ink(view, ink.float()[:, None] / 255.0, colour, opacity))
    return Pair(*views)


def _ink(
    view: ViewBatch,
    ink: Tensor,  # [B, 1, H, W] in [0, 1]
    colour: Tensor,  # [B, 1, 1, 1]
    opacity: Tensor,  # [B, 1, 1, 1]
) -> ViewBatch:
    image = torch.lerp(view.image, colour.expand_as(view.image), ink * opacity)
    covered = F.max_pool2d(ink, 3, 1, 1)[:, 0] > 0.0
    return replace(view, image=image, valid=view.valid & ~covered)


def _draw(
    draw: Draw, height: int, width: int
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """[H, W] ink in [0, 255] of both pictures."""
    first = np.zeros((height, width), np.uint8)
    second = first.copy()
    lines, *numbers = draw.whole(1 + LINES * (LONGEST + CHANGING), below=1 << 16).tolist()
    places = draw.uniform(LINES, 3).tolist()
    for number in range(1 + lines % LINES):
        own = numbers[number * (LONGEST + CHANGING) : (number + 1) * (LONGEST + CHANGING)]
        text = "".join(CHARACTERS[n % len(CHARACTERS)] for n in own[: 3 + own[0] % (LONGEST - 3)])
        later = text[:-CHANGING] + "".join(CHARACTERS[n % 10] for n in own[LONGEST:])
        x, y, large = places[number]
        scale = SCALE[0] + (SCALE[1] - SCALE[0]) * large
        # Mostly along the upper and lower border, as recorders write.
        row = (0.12 + 0.1 * y) if y < 0.45 else (0.8 + 0.18 * y) if y < 0.9 else 10.0 * (y - 0.9)
        at = (round((0.7 * x - 0.05) * width), round(min(row, 0.97) * height))
        for picture, words in ((first, text), (second, later)):
            cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, 1, cv2.LINE_AA)
    kind = numbers[-1] % 6
    for picture in (first, second):
        _rule(picture, kind)
    return first, second


def _rule(
    picture: npt.NDArray[np.uint8],  # [H, W], drawn on
    kind: int,
) -> None:
    """0: cross-hairs; 1: a frame; 2: bars above and below; others: nothing."""
    height, width = picture.shape
    if kind == 0:
        middle, arm = (width // 2, height // 2), width // 12
        cv2.line(picture, (middle[0] - arm, middle[1]), (middle[0] + arm, middle[1]), 255, 1)
        cv2.line(picture, (middle[0], middle[1] - arm), (middle[0], middle[1] + arm), 255, 1)
    elif kind == 1:
        edge = width // 16
        cv2.rectangle(picture, (edge, edge), (width - edge, height - edge), 255, 1)
    elif kind == 2:
        picture[: height // 12] = 255
        picture[height - height // 12 :] = 255
