"""What is odd about pictures before they are mapped, in words for the user."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

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


def oddities(
    pictures: Sequence[npt.NDArray[np.uint8]],  # [H, W, 3] each
    step: int = STEP,
) -> list[str]:
    """Clauses on pictures [H, W, 3] that follow each other; none for usual ones. Every ``step``-th
    pixel is looked at."""
    if not pictures:
        return []
    small = [
        picture[::step, ::step].mean(axis=2)
        for picture in pictures
        if picture.shape == pictures[0].shape
    ]
    count, said = len(small), []
    flat = sum(float(grey.std()) < FLAT for grey in small)
    for number, words in (
        (sum(float(grey.mean()) < DARK for grey in small), "nearly black"),
        (sum(float(grey.mean()) > BRIGHT for grey in small), "nearly white"),
        (flat, "of one colour"),
    ):
        if number > MOST_SHARE * count:
            said.append(f"{number} of {count} pictures are {words}")
    if flat > MOST_SHARE * count or count < 2:
        return said
    pairs = list(pairwise(small))
    repeated = sum(np.array_equal(a, b) for a, b in pairwise(pictures))
    if max(float(np.abs(grey - small[0]).mean()) for grey in small) < STILL:
        said.append("nothing moves: all pictures show the same")
    elif repeated > MOST_SHARE * len(pairs):
        said.append(f"{repeated} of {count} pictures repeat the one before")
    cuts = sum(_correlation(a, b) < CUT for a, b in pairs)
    if 0 < cuts <= MOST_SHARE * len(pairs):  # stills of a survey are all unlike
        said.append(f"the scene changes from one picture to the next {cuts} times")
    return said


def _correlation(
    a: npt.NDArray[np.float64],  # [H, W]
    b: npt.NDArray[np.float64],  # [H, W]
) -> float:
    if a.std() < FLAT or b.std() < FLAT:
        return 1.0
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])
