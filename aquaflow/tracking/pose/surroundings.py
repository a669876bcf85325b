"""Inverse depth around every pixel of a pointmap, without the pixel's own error.

Depths are known to a few percent, and what is multiplied or selected by them shares their noise: a
translation solved with derivatives at noisy depths is too short by their relative variance (errors
in variables), and of far points those that noise brought nearer pass a limit on the relative
precision. The depths around a pixel have other errors. What is weighted and selected by them is
unbiased, however well the variances of depths and matches are known (instrumental variables:
Durbin, Review of the International Statistical Institute 1954).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.keyframes import Pointmap

Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

CELL_PX = 4
"""Side of the cells that the mean is taken over; one value serves all pixels of a cell."""
OUTER_CELLS = 7
"""Side of the square around a cell that its mean is taken over."""
INNER_CELLS = 3
"""Side of the square around a cell that is left out: matches 4 px away or nearer share their
windows (prior/flow.py), and their errors."""
LEAST_CELLS = 2.5
"""Known part of the square, in cells, below which nothing is known around: 40 pixels."""


def surroundings(
    pointmap: Pointmap,
    relative_sigma: float,
) -> tuple[Float, Mask]:
    """Inverse depth around every pixel, [H, W]; and the pixels, [H, W], whose own is known to
    better than ``relative_sigma`` of that. Where nothing is known around, it is the pixel's own."""
    around = _mean_around(pointmap.rho.astype(np.float32), pointmap.is_known(relative_sigma))
    known = (pointmap.rho > 1e-6) & (pointmap.variance < (relative_sigma * around) ** 2)
    return around, known


def _mean_around(
    rho: Float,  # [H, W]
    known: Mask,  # [H, W]
) -> Float:
    import cv2

    height, width = rho.shape
    cells = (max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX)))
    mass = known.astype(np.float32)
    around = []
    for field in (mass, mass * rho):
        sums = cv2.resize(field, cells, interpolation=cv2.INTER_AREA)
        outer, inner = (
            cv2.boxFilter(sums, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
            for side in (OUTER_CELLS, INNER_CELLS)
        )
        around.append(outer - inner)
    count, total = around
    enough = count > LEAST_CELLS
    mean = np.where(enough, total / np.where(enough, count, 1.0), 0.0).astype(np.float32)
    everywhere = cv2.resize(mean, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(np.where(everywhere > 0.0, everywhere, rho), dtype=np.float32)
