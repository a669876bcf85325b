"""Points anchored in keyframes: where they were sampled, and where other keyframes see them."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import Float, Mask, PairGeometry

Array = npt.NDArray[np.float64]
Small = npt.NDArray[np.int16]

ACROSS = 4
"""Columns over rows of the cells that points are spread over is that of a 4:3 picture."""
DOWN = 3
HELD_OUT_EVERY = 5
"""Every fifth point takes no part in an adjustment: it judges it."""
RETURN_PX = 0.4
"""Distance from which a match comes back: twice the noise of a refined match."""


@dataclass
class AnchoredPoints:
    """P points of one keyframe."""

    keyframe: int
    camera: CameraModel
    rows: Small
    """[P] pixel."""
    columns: Small
    """[P] pixel."""
    rho: Float
    """[P] inverse depth as fused, in the unit of the keyframe; 0 where unknown."""
    variance: Float
    """[P] of ``rho``."""
    seen: dict[int, Float] = field(default_factory=dict)
    """By the number of another keyframe: [P, 2] normalised plane; NaN where it is not seen."""

    @property
    def rays(self) -> Array:
        """[P, 3] through the pixels' centres, z = 1."""
        return self.camera.unproject(np.stack([self.columns + 0.5, self.rows + 0.5], axis=-1))

    @property
    def held_out(self) -> Mask:
        """[P] which points judge adjustments and take no part in them."""
        return np.asarray(np.arange(len(self.rho)) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1)

    def take_depths(self, pointmap: Pointmap) -> None:
        """The depths that the keyframe's pointmap has now."""
        self.rho = pointmap.rho[self.rows, self.columns].astype(np.float32)
        self.variance = pointmap.variance[self.rows, self.columns].astype(np.float32)

    def see(
        self,
        other: AnchoredPoints,
        ahead: Float,  # [H, W, 2] px, where every pixel of this keyframe is in the other
        back: Float,  # [H, W, 2] px, where every pixel of the other is in this one
        valid: Mask,  # [H, W] of this keyframe
    ) -> None:
        """Record where another keyframe sees the points: matches that come back to them."""
        pixels = ahead[self.rows, self.columns].astype(np.float64)
        known = valid[self.rows, self.columns] & np.isfinite(pixels).all(axis=1)
        pixels = np.where(known[:, None], pixels, 0.5)
        start = np.stack([self.columns + 0.5, self.rows + 0.5], axis=-1)
        known &= np.linalg.norm(_between(back, pixels) - start, axis=1) < RETURN_PX
        plane = other.camera.unproject(pixels)[:, :2]
        self.seen[other.keyframe] = np.where(known[:, None], plane, np.nan).astype(np.float32)


def sampled_points(
    keyframe: int,
    pointmap: Pointmap,
    texture: Float,  # [H, W]
    interesting: Mask,  # [H, W]
    count: int,
) -> AnchoredPoints:
    """The pixel with most texture in each of about ``count`` cells that has any."""
    height, width = texture.shape
    across = max(1, round(np.sqrt(count * ACROSS / DOWN)))
    down = max(1, round(count / across))
    strength = np.where(interesting, texture, 0.0)
    row_edges = np.linspace(0, height, down + 1).astype(int)
    column_edges = np.linspace(0, width, across + 1).astype(int)
    rows, columns = [], []
    for top, bottom in pairwise(row_edges):
        for left, right in pairwise(column_edges):
            cell = strength[top:bottom, left:right]
            best = int(np.argmax(cell))
            if cell.flat[best] > 0.0:
                rows.append(top + best // (right - left))
                columns.append(left + best % (right - left))
    points = AnchoredPoints(
        keyframe, pointmap.camera, np.array(rows, np.int16), np.array(columns, np.int16),
        np.zeros(0, np.float32), np.zeros(0, np.float32),
    )  # fmt: skip
    points.take_depths(pointmap)
    return points


def see_each_other(a: AnchoredPoints, b: AnchoredPoints, pair: PairGeometry) -> None:
    """Record what the matches of ``pair``, a to b, say about the points of both."""
    a.see(b, pair.matches, pair.matches_back, pair.valid)
    b.see(a, pair.matches_back, pair.matches, pair.valid_back)


def _between(
    field: Float,  # [H, W, 2]
    pixels: Array,  # [M, 2] px
) -> Array:
    """[M, 2] bilinear values."""
    height, width = field.shape[:2]
    at = np.clip(pixels - 0.5, 0.0, (width - 1.0, height - 1.0))
    column = np.minimum(at[:, 0].astype(np.intp), width - 2)
    row = np.minimum(at[:, 1].astype(np.intp), height - 2)
    right, below = at[:, 0] - column, at[:, 1] - row
    above = field[row, column] * (1 - right)[:, None] + field[row, column + 1] * right[:, None]
    under = (
        field[row + 1, column] * (1 - right)[:, None] + field[row + 1, column + 1] * right[:, None]
    )
    return np.asarray(above * (1 - below)[:, None] + under * below[:, None])
