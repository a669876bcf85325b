"""Where the Gaussians of a map lie: which of them a camera or a box can meet.

Along a space-filling curve (G. M. Morton, "A Computer Oriented Geodetic Data Base", 1966)
neighbours follow each other, so that blocks of some hundreds of them have small bounding boxes. A
picture shows a few blocks of a long dive, and the others need not be looked at one by one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.render.limits import DILATION_PX2, MIN_ALPHA, NEAR_PLANE_M, TANGENT_MARGIN

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]

BLOCK = 256
"""Gaussians of a block: twenty thousand blocks of five million are tested in some milliseconds."""
CHUNK = 64
"""Gaussians that the renderer's kernels take together; those that are left over are taken one by
one, which rounds otherwise."""
BITS = 16
"""Of a coordinate along the curve: 65,536 steps along the longest side of the map."""
INNER_SHARE = (1.0, 99.0)
"""Percentiles of the coordinates that the curve runs through; what lies beyond is at its rim."""
REACH_SIGMAS = float(np.sqrt(-2.0 * np.log(MIN_ALPHA)))
"""Standard deviations, 3.3, at which the most opaque Gaussian falls below one grey level."""
SLACK_PX = 1.0
"""By which an ellipse may be wider here than the renderer's, which rounds to float32."""


class SpatialIndex:
    """Blocks of neighbours among N Gaussians, which must not change from here on."""

    def __init__(
        self,
        means: npt.NDArray[np.floating[Any]],  # [N, 3]
        sigmas: npt.NDArray[np.floating[Any]],  # [N] largest standard deviation of each
    ) -> None:
        """What is not finite draws nothing, and may lie anywhere."""
        means = np.nan_to_num(means, posinf=0.0, neginf=0.0)
        self._order = np.argsort(_along_curve(means), kind="stable").astype(np.int32)
        starts = np.arange(0, len(means), BLOCK)
        places, sizes = means[self._order], np.nan_to_num(sigmas)[self._order]
        self._low = np.minimum.reduceat(places, starts, axis=0).astype(np.float64)
        self._high = np.maximum.reduceat(places, starts, axis=0).astype(np.float64)
        self._sigma = np.maximum.reduceat(sizes, starts).astype(np.float64)

    def in_picture(self, camera: CameraModel, T_wc: Sim3) -> Rows:
        """[M] numbers, ascending, of a superset of the Gaussians that the renderer draws for a
        pinhole ``camera`` at ``T_wc``: the picture of these alone is the same bit for bit."""
        R_cw = T_wc.R.T
        middle = (0.5 * (self._low + self._high) - T_wc.t) @ R_cw.T
        half = 0.5 * (self._high - self._low) @ np.abs(R_cw).T
        low, high = middle - half, middle + half
        near, far = np.maximum(low[:, 2], NEAR_PLANE_M), np.maximum(high[:, 2], NEAR_PLANE_M)
        seen = high[:, 2] >= NEAR_PLANE_M
        axes = (camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height)
        for axis, (f, c, side) in enumerate(axes):
            first, last = low[:, axis], high[:, axis]
            first = f * np.where(first < 0.0, first / near, first / far) + c
            last = f * np.where(last > 0.0, last / near, last / far) + c
            # The Jacobian of the projection has a row as long as this at most.
            tangent = (max(c, side - c) + TANGENT_MARGIN * side) / f
            sigma_px = self._sigma * f / near * np.sqrt(1.0 + tangent**2)
            reach = REACH_SIGMAS * np.sqrt(sigma_px**2 + DILATION_PX2) + SLACK_PX
            seen &= (last + reach >= 0.0) & (first - reach <= side)
        return self._whole_chunks(self._rows(seen))

    def _whole_chunks(
        self,
        rows: Rows,  # [M]
    ) -> Rows:
        """``rows`` [M] with some others, so that each is in a whole chunk where it is in one among
        all N, and in the rest where it is in that."""
        count = len(self._order)
        whole = count - count % CHUNK
        chosen = np.zeros(whole, dtype=bool)  # NumPy's set operations take 100 times as long
        chosen[rows[rows < whole]] = True
        missing = -np.count_nonzero(chosen) % CHUNK
        chosen[np.flatnonzero(~chosen)[:missing]] = True
        return np.concatenate([np.flatnonzero(chosen), np.arange(whole, count)])

    def in_box(
        self,
        low: Array,  # [D], D <= 3: of the first coordinates
        high: Array,  # [D]
        sigmas: float,
    ) -> Rows:
        """[M] numbers, ascending, of a superset of the Gaussians that come into a box within so
        many standard deviations."""
        reach, axes = sigmas * self._sigma[:, None], slice(len(low))
        met = (self._low[:, axes] <= high + reach) & (self._high[:, axes] >= low - reach)
        return self._rows(np.asarray(met.all(axis=1)))

    def _rows(
        self,
        chosen: npt.NDArray[np.bool_],  # [B] of the blocks
    ) -> Rows:
        places = (np.flatnonzero(chosen)[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        return np.sort(self._order[places[places < len(self._order)]]).astype(np.intp)


def _along_curve(
    means: npt.NDArray[np.floating[Any]],  # [N, 3] finite
) -> npt.NDArray[np.uint64]:
    """[N] places along the curve."""
    if not len(means):
        return np.zeros(0, np.uint64)
    low, high = np.percentile(means, INNER_SHARE, axis=0)
    step = max(float((high - low).max()), 1e-9) / (1 << BITS)
    keys = np.zeros(len(means), np.uint64)
    for axis in range(3):
        steps = np.clip((means[:, axis] - low[axis]) / step, 0, (1 << BITS) - 1)
        keys |= _spread(steps.astype(np.uint64)) << np.uint64(axis)
    return keys


def _spread(
    steps: npt.NDArray[np.uint64],  # [N] below 2^16
) -> npt.NDArray[np.uint64]:
    """[N] with two zeros between bits."""
    for shift, mask in (
        (16, 0xFF0000FF),
        (8, 0x0F00F00F00F),
        (4, 0x0C30C30C30C3),
        (2, 0x249249249249),
    ):
        steps = (steps | (steps << np.uint64(shift))) & np.uint64(mask)
    return steps
