"""Local space average colour: the illumination of each pixel, as Sea-thru estimates it.

The average spreads from neighbour to neighbour where their ranges are alike (after Ebner, Color
Constancy, 2007): a = p D + (1 - p) mean of a over those neighbours. The fixed point of that
iteration is a sparse linear system, which is solved here instead.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import spsolve

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

WIDTH_PX = 120
"""The illumination is smooth: it is found at this width."""
REACH_PX = 8.0
"""Distance over which the average spreads, at that width."""
OWN_SHARE = 1.0 / (1.0 + 4.0 * REACH_PX**2)
"""p; on a grid of four neighbours the average spreads over sqrt((1 - p) / (4 p)) pixels."""
ALIKE = 0.1
"""Neighbours whose ranges differ by less, in median ranges, share their light."""
GEOMETRY = 2.0
"""f: illumination over average colour, for a scene that faces the camera."""


def local_average(
    direct: Array,  # [H, W, 3] without backscatter
    z: Array,  # [H, W] over the median range, 0 where unknown
    known: Mask,  # [H, W]
) -> tuple[Array, Array]:
    """Illumination [M, 3] and range [M] of the pixels of a smaller picture."""
    direct, z, known = _smaller(direct, z, known)
    if not known.any():
        return np.zeros((0, 3)), np.zeros(0)
    near = _neighbours(z, known)
    degree = np.asarray(near.sum(axis=1)).ravel()
    # Multiplied by the number of neighbours the matrix is symmetric; a lone pixel keeps its own.
    own = np.where(degree > 0.0, OWN_SHARE * degree, 1.0)
    system = sparse.diags(np.maximum(degree, own)) - (1.0 - OWN_SHARE) * near
    light = spsolve(system.tocsc(), own[:, None] * direct[known])
    return GEOMETRY * np.asarray(light), z[known]


def _smaller(
    direct: Array,  # [H, W, 3]
    z: Array,  # [H, W]
    known: Mask,  # [H, W]
) -> tuple[Array, Array, Mask]:
    """Means over the known pixels of each cell."""
    height, width = known.shape
    size = (min(WIDTH_PX, width), max(1, round(height * min(WIDTH_PX, width) / width)))

    def mean(values: Array) -> Array:  # [H, W, ...]
        return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float64)

    share = mean(known.astype(np.float64))
    inside = share > 0.5
    safe = np.where(inside, share, 1.0)
    weighted = mean(np.where(known[..., None], direct, 0.0)) / safe[..., None]
    return weighted, mean(np.where(known, z, 0.0)) / safe, inside


def _neighbours(
    z: Array,  # [H, W]
    known: Mask,  # [H, W]
) -> sparse.csr_matrix:
    """[M, M] 1 for pairs of known pixels next to each other at like range."""
    number = np.full(known.shape, -1)
    number[known] = np.arange(int(known.sum()))
    rows, columns = [], []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        alike = known[a] & known[b] & (np.abs(z[a] - z[b]) < ALIKE)
        rows += [number[a][alike], number[b][alike]]
        columns += [number[b][alike], number[a][alike]]
    i, j, count = np.concatenate(rows), np.concatenate(columns), int(known.sum())
    return sparse.csr_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
