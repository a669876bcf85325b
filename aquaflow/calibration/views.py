"""The pictures that a calibration is made from: those that show the board, each unlike the rest."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.calibration.board import Detector, Found

Array = npt.NDArray[np.float64]

LEAST_CORNERS = 8
"""Of a picture; six of its numbers are the board's pose."""
LEAST_VIEWS = 8
"""Pictures that differ: fewer leave the focal length to chance, whatever its formal sigma."""
MOST_VIEWS = 60
"""More cost time and teach nothing; a video shows the board in a thousand."""
LEAST_MOVE = 0.02
"""Of the picture's width, in the mean over the corners: pictures closer than this are alike."""
COVERAGE_CELLS = 8
"""Cells along each side of the picture, of which a share is covered by corners."""


@dataclass(frozen=True)
class BoardImage:
    """One picture with the board in it."""

    name: str
    found: Found


@dataclass(frozen=True)
class Views:
    """The pictures of one size that a calibration uses, and what was left out."""

    width: int
    height: int
    used: list[BoardImage]
    read: int
    """Pictures in all."""
    without_board: list[str]
    alike: list[str]

    @property
    def coverage(self) -> float:
        """Share of the picture, in cells, in which corners were seen."""
        cells = np.concatenate([view.found.pixels for view in self.used])
        cells = cells / (self.width, self.height) * COVERAGE_CELLS
        inside = np.clip(cells, 0, COVERAGE_CELLS - 1).astype(int)
        return len(np.unique(inside, axis=0)) / COVERAGE_CELLS**2


def find_views(
    pictures: Iterable[tuple[str, npt.NDArray[np.uint8]]],  # [H, W, 3] RGB
    detector: Detector,
) -> Views:
    """Look for the board in every picture.

    Raises:
        InputError: the pictures are of several sizes, too few show the board, or too few of those
            differ.
    """
    used: list[BoardImage] = []
    without, alike, size, read = [], [], (0, 0), 0
    for name, image in pictures:
        height, width = image.shape[:2]
        if size not in ((0, 0), (width, height)):
            raise InputError(
                f"{name} is {width} x {height}, those before it {size[0]} x {size[1]}; give "
                "pictures of one size"
            )
        size, read = (width, height), read + 1
        found = detector(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8))
        if not _determines_a_pose(found):
            without.append(name)
        elif any(_alike(found, other.found, LEAST_MOVE * width) for other in used):
            alike.append(name)
        else:
            used.append(BoardImage(name, found))
    views = Views(*size, _spread(used), read, without, alike)
    _refuse_too_few(views)
    return views


def _refuse_too_few(views: Views) -> None:
    shown = views.read - len(views.without_board)
    if shown < LEAST_VIEWS:
        raise InputError(
            f"{shown} of {views.read} pictures show the board, {LEAST_VIEWS} are needed; check "
            "--board, --columns, --rows and --square-mm, and that the board is sharp and whole"
        )
    if len(views.used) < LEAST_VIEWS:
        raise InputError(
            f"only {len(views.used)} of {shown} pictures of the board differ, {LEAST_VIEWS} are "
            "needed; move the board to every part of the picture and tilt it by 30 degrees"
        )


def _determines_a_pose(found: Found) -> bool:
    if len(found.numbers) < LEAST_CORNERS:
        return False
    flat = found.points_m[:, :2] - found.points_m[:, :2].mean(axis=0)
    spread = np.linalg.svd(flat, compute_uv=False)
    return bool(spread[1] > 0.1 * spread[0])  # in one row they leave the pose open


def _alike(one: Found, other: Found, least_px: float) -> bool:
    _, mine, theirs = np.intersect1d(one.numbers, other.numbers, return_indices=True)
    if len(mine) < LEAST_CORNERS:
        return False
    moved = np.linalg.norm(one.pixels[mine] - other.pixels[theirs], axis=1)
    return bool(moved.mean() < least_px)


def _spread(views: list[BoardImage]) -> list[BoardImage]:
    """At most MOST_VIEWS of them, evenly over the order in which they were taken."""
    if len(views) <= MOST_VIEWS:
        return views
    return [views[k] for k in np.linspace(0, len(views) - 1, MOST_VIEWS).astype(int)]
