"""Which pictures make pairs: those that share 30 % of their back-projected pixels (Sec. 3.1)."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.base.errors import InputError
from aquaflow.lab.training.datasets.posed import Posed
from aquaflow.lab.training.datasets.posed import Sequence as Scene
from aquaflow.lab.training.pairs import Pair, ViewBatch, nearest_pixels, overlap, project, seen_from

LEAST_OVERLAP = 0.3
"""Of the valid pixels, seen by both (paper, Sec. 3.1)."""
MOST_OVERLAP = 0.95
"""Beyond, both pictures show the same from the same place, and the pair teaches nothing."""
GAPS = (1, 2, 3, 5, 8, 13, 21, 34, 55)
"""Pictures between the two of a pair."""
LEAST_VALID = 0.1
"""Share of a picture's pixels that must be valid."""
MINING_PX = (128, 96)
"""Width and height at which overlap is measured: its error is a hundredth of the picture."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class PairIndex:
    """Where a pair is."""

    sequence: int
    a: int
    b: int
    overlap: float


def mine(scenes: Sequence[Scene], progress: Progress) -> list[PairIndex]:
    """Every pair of the gaps that overlaps enough; a pair that cannot be read is skipped.

    Along a sequence a gap is not widened beyond the first at which the overlap is lost.
    """
    found: list[PairIndex] = []
    for number, scene in enumerate(scenes):
        views = _Small(scene)
        for a in range(len(scene)):
            found += _pairs_from(number, a, views)
            views.forget(a)
        progress("pairs", number + 1, len(scenes))
    return found


def _pairs_from(number: int, a: int, views: _Small) -> list[PairIndex]:
    found = []
    for gap in GAPS:
        if a + gap >= len(views):
            break
        first, second = views[a], views[a + gap]
        if first is None or second is None:
            continue
        shared = float(overlap(Pair(first, second))[0])
        if shared < LEAST_OVERLAP:
            break
        if shared <= MOST_OVERLAP:
            found.append(PairIndex(number, a, a + gap, round(shared, 3)))
    return found


class _Small:
    """Small views of a sequence, each read once and kept while pairs may need it."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._views: dict[int, ViewBatch | None] = {}

    def __len__(self) -> int:
        return len(self._scene)

    def __getitem__(self, index: int) -> ViewBatch | None:
        """None where it cannot be read, or shows too little."""
        if index not in self._views:
            try:
                view = view_of(self._scene[index], *MINING_PX)
            except InputError:
                self._views[index] = None
            else:
                enough = float(view.valid.float().mean()) >= LEAST_VALID
                self._views[index] = view if enough else None
        return self._views[index]

    def forget(self, index: int) -> None:
        self._views.pop(index, None)


@dataclass(frozen=True)
class MinedPairs:
    """Pairs as batches, at the size that the network takes."""

    scenes: Sequence[Scene]
    index: Sequence[PairIndex]
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.index)

    @cached_property
    def kinds(self) -> list[str]:
        """Data set of each pair."""
        return [self.scenes[pair.sequence].kind for pair in self.index]

    def pair(
        self,
        numbers: Sequence[int],
        zooms: Tensor | None = None,  # [B, 2] of either view, at least 1; None: 1
    ) -> Pair:
        """A batch; the first view of each pair is at the origin, and nothing that moved is valid.

        Poses go in as float64 and out as float32 only after the world's far origin was left.
        """
        factors = [(1.0, 1.0)] * len(numbers) if zooms is None else zooms.tolist()
        rows = zip(numbers, factors, strict=True)
        pairs = [self._one(self.index[number], *zoom) for number, zoom in rows]
        return Pair(_batch([pair.a for pair in pairs]), _batch([pair.b for pair in pairs]))

    def _one(self, index: PairIndex, zoom_a: float, zoom_b: float) -> Pair:
        scene = self.scenes[index.sequence]
        first, second = scene[index.a], scene[index.b]
        T_aw = np.linalg.inv(first.T_wc)
        a = view_of(first, self.width, self.height, T_aw, zoom_a)
        b = view_of(second, self.width, self.height, T_aw, zoom_b)
        return Pair(_without(a, is_moved(a, b)), _without(b, is_moved(b, a)))


def save_index(pairs: Sequence[PairIndex], path: Path) -> None:
    """One line of JSON for each."""
    path.write_text("".join(json.dumps(asdict(pair)) + "\n" for pair in pairs))


def load_index(path: Path) -> list[PairIndex]:
    """What ``save_index`` wrote.

    Raises:
        InputError: it is something else.
    """
    try:
        return [PairIndex(**json.loads(line)) for line in path.read_text().splitlines()]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path} is no list of pairs; delete it, and they are found again") from (
            error
        )


def _without(
    view: ViewBatch,
    mask: torch.Tensor,  # [B, H, W] bool
) -> ViewBatch:
    return ViewBatch(view.image, view.depth, view.K, view.T_wc, view.valid & ~mask)


def _batch(views: Sequence[ViewBatch]) -> ViewBatch:
    names = ("image", "depth", "K", "T_wc", "valid")
    return ViewBatch(*(torch.cat([getattr(view, name) for view in views]) for name in names))


# --------------------------------------------------------------------------------------------------
# Posed pictures made views of the size that a network takes.


def view_of(
    posed: Posed,
    width: int,
    height: int,
    T_rw: npt.NDArray[np.floating] | None = None,  # [4, 4] world to reference
    zoom: float = 1.0,
) -> ViewBatch:
    """[1, ...] the picture's middle, as large as fits, seen ``zoom`` times as large; poses are of
    the camera to ``r``.

    Depth is never averaged: between near and far there is nothing.
    """
    old_height, old_width = posed.depth.shape
    scale = zoom * max(width / old_width, height / old_height)
    size = (max(width, round(scale * old_width)), max(height, round(scale * old_height)))
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    window = (slice(top, top + height), slice(left, left + width))
    image = cv2.resize(posed.image, size, interpolation=way)[window]
    depth = cv2.resize(posed.depth, size, interpolation=cv2.INTER_NEAREST)[window]
    valid = cv2.resize(valid_pixels(posed).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)[
        window
    ]
    K = np.diag([size[0] / old_width, size[1] / old_height, 1.0]) @ posed.K
    K[:2, 2] -= (left, top)
    T = posed.T_wc if T_rw is None else T_rw @ posed.T_wc
    # Unknown depths are 1: what is not a number would be one in every sum, masked or not.
    known = valid.astype(bool)
    return ViewBatch(
        torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))[None]).float() / 255.0,
        torch.from_numpy(np.where(known, depth, 1.0)[None]).float(),
        torch.from_numpy(K[None]).float(),
        torch.from_numpy(np.ascontiguousarray(T)[None]).float(),
        torch.from_numpy(known[None]),
    )


# --------------------------------------------------------------------------------------------------
# Which pixels teach: not the moving, the mirroring, the veiled, or those of unknown depth.
#
# Paper, Sec. 3.1: "joint geometric and semantic masking to remove dynamic objects, invalid depth
# regions, specular highlights, and scattering artifacts". What moved is found from geometry here: a
# point of one view in front of what the other view sees there was not there any more.

Mask = npt.NDArray[np.bool_]

NEAR_M, FAR_M = 0.1, 80.0
"""Depths beyond are the simulator's sky, and no camera in water sees there."""
HIGHLIGHT = 250
"""Grey level that all three channels reach in a mirrored lamp or sun."""
HIGHLIGHT_BORDER_PX = 2
"""Around a highlight, its glare."""
CONTRAST_WINDOW_PX = 15
"""Edge of the window that the contrast is measured in."""
VEILED = 0.7
"""Grey levels of contrast: rounding alone makes 0.3, and where no more is left only the veil is
seen."""
THROUGH = 0.1
"""Share of its depth by which a point lies in front of what the other view sees in its place."""


def valid_pixels(posed: Posed) -> Mask:
    """[H, W] of one picture alone: depth is known, no highlight, not lost in the veil."""
    known = np.isfinite(posed.depth) & (posed.depth > NEAR_M) & (posed.depth < FAR_M)
    return known & ~_highlights(posed.image) & ~_veil(posed.image)


def is_moved(a: ViewBatch, b: ViewBatch) -> Tensor:
    """[B, H, W] bool: a's point would hide what b sees there, so it was elsewhere by then."""
    points = seen_from(b.T_wc, a.points(), a.T_wc)
    pixels, inside = project(points, b)
    rows, columns = nearest_pixels(pixels, b)
    batch = torch.arange(len(rows), device=rows.device)[:, None, None]
    seen = b.depth[batch, rows, columns]
    known = inside & a.valid & b.valid[batch, rows, columns]
    return known & (seen > (1.0 + THROUGH) * points[..., 2])


def _highlights(
    image: npt.NDArray[np.uint8],  # [H, W, 3]
) -> Mask:
    bright = (image.min(axis=2) >= HIGHLIGHT).astype(np.uint8)
    side = 2 * HIGHLIGHT_BORDER_PX + 1
    return np.asarray(cv2.dilate(bright, np.ones((side, side), np.uint8)) > 0)


def _veil(
    image: npt.NDArray[np.uint8],  # [H, W, 3]
) -> Mask:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    size = (CONTRAST_WINDOW_PX, CONTRAST_WINDOW_PX)
    mean = cv2.blur(grey, size)
    variance = np.maximum(cv2.blur(grey * grey, size) - mean * mean, 0.0)
    return np.asarray(np.sqrt(variance) < VEILED)
