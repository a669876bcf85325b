"""A fit in the manner of Sea-thru (Akkaynak and Treibitz, CVPR 2019) on given ranges.

Backscatter comes from the darkest pixels of every range, the attenuation from how the local
illumination falls with range. The paper fits single raw pictures. Here they are those that the map
was made from, and one water is fitted to all of them, which restores them better.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse.linalg import spsolve

from aquaflow.lab.evaluation.water_peers.backscatter import backscatter, fit_backscatter
from aquaflow.lab.evaluation.water_peers.contract import NotRestoredError, Pictures, Ranges

Array = npt.NDArray[np.float64]

FEWEST_PIXELS = 2000
"""With known range, in all pictures: a tenth of the range holds some hundred of them, and their
darkest percentile at least one."""
SMALLEST_SPAN = 1.1
"""Farthest over nearest range; less says nothing about how light falls with range."""
RANGE_PERCENTILES = (1.0, 50.0, 99.0)
"""Percent; values outside are single pixels at edges of the map."""
FIT_VIEWS = 20
"""Evenly taken from all; more would add time and memory, and no other water."""
LONGEST_DEPTH = 30.0
"""Optical depth; exp(30) exceeds any picture's values by far and is still a number."""


@dataclass(frozen=True)
class _Water:
    near: float
    far: float
    """Ranges outside of these are held there: only edges of the map have them."""
    median: float
    """Of the ranges; the rates below are per this range."""
    veil: Array
    """[3, 4] for ``backscatter``."""
    rates: Array
    """[3, 4] for ``two_exponentials``."""


def restore(
    pictures: Pictures,  # [N, H, W, 3] in [0, 1]
    ranges: Ranges | None,  # [N, H, W] in any unit
) -> Pictures:
    """Take backscatter and attenuation off; black where the range is unknown.

    Raises:
        NotRestoredError: there are no ranges, too few, or they and the pictures show no water.
    """
    if ranges is None:
        raise NotRestoredError("the ranges of the held-out views are missing or damaged")
    every = -(-len(pictures) // FIT_VIEWS)
    water = _fit(pictures[::every], ranges[::every])
    restored = np.stack([_restore(*view, water) for view in zip(pictures, ranges, strict=True)])
    # In each channel the brightest of all views is white; some light is left, or there was no fit.
    return np.asarray(restored / restored.max(axis=(0, 1, 2)), np.float32)


def _fit(
    pictures: Pictures,  # [N, H, W, 3]
    ranges: Ranges,  # [N, H, W]
) -> _Water:
    known = _known_ranges(ranges)
    if known.sum() < FEWEST_PIXELS:
        raise NotRestoredError(f"fewer than {FEWEST_PIXELS} pixels have a range")
    near, median, far = map(float, np.percentile(ranges[known], RANGE_PERCENTILES))
    if far < SMALLEST_SPAN * near:
        raise NotRestoredError(f"the ranges span less than 1:{SMALLEST_SPAN}")
    z = np.where(known, np.clip(ranges.astype(np.float64), near, far) / median, 0.0)
    veil = fit_backscatter(pictures[known].astype(np.float64), z[known])
    direct = np.zeros(pictures.shape)
    direct[known] = np.maximum(pictures[known] - backscatter(veil, z[known]), 0.0)
    found = [local_average(*view) for view in zip(direct, z, known, strict=True)]
    light, at = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _Water(near, far, median, veil, fit_attenuation(light, at))


def _restore(
    picture: Pictures,  # [H, W, 3]
    ranges: Ranges,  # [H, W]
    water: _Water,
) -> Pictures:
    """[H, W, 3] J, 0 where the range is unknown; its unit is the light of the fit."""
    known = _known_ranges(ranges)
    z = np.clip(ranges[known].astype(np.float64), water.near, water.far) / water.median
    direct = np.maximum(picture[known] - backscatter(water.veil, z), 0.0)
    depth = np.stack([two_exponentials(rate, z) * z for rate in water.rates], axis=-1)
    restored = np.zeros(picture.shape, np.float32)
    restored[known] = direct * np.exp(np.minimum(depth, LONGEST_DEPTH))
    return restored


def _known_ranges(
    ranges: Ranges,  # [...]
) -> npt.NDArray[np.bool_]:
    return np.asarray(np.isfinite(ranges) & (ranges > 0.0))


# --------------------------------------------------------------------------------------------------
# Local space average colour: the illumination of each pixel, as Sea-thru estimates it.
#
# The average spreads from neighbour to neighbour where their ranges are alike (after Ebner, Color
# Constancy, 2007): a = p D + (1 - p) mean of a over those neighbours. The fixed point of that
# iteration is a sparse linear system, which is solved here instead.

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


# --------------------------------------------------------------------------------------------------
# Attenuation that changes with range, from the illumination, as Sea-thru fits it.

BINS = 200
"""Ranges with as many pixels each, whose medians are fitted: on four dives as good as fitting the
pixels themselves, or up to 1.5 dB better."""
FEWEST = 20
"""Bins with light in every channel; four parameters are fitted to them."""
DARKEST_LIGHT = 1.0 / 255.0
"""Illumination below one step of 8 bits is noise."""
LARGEST_RATE = 20.0
"""Per median range; bounds what the exponentials add up to."""
STEEPEST = 20.0
"""Fall of the attenuation per median range."""


def two_exponentials(
    parameters: Array,  # [4] a, b, c, d
    z: Array,  # [M]
) -> Array:
    """[M] attenuation a exp(b z) + c exp(d z), b and d negative."""
    a, b, c, d = parameters
    return np.asarray(a * np.exp(b * z) + c * np.exp(d * z))


def fit_attenuation(
    light: Array,  # [M, 3] local illumination
    z: Array,  # [M] over the median range
) -> Array:
    """[3, 4] parameters for :func:`two_exponentials` of each channel.

    The range that the illumination implies, -log E / beta(z), is brought closest to ``z``.

    Raises:
        NotRestoredError: too little is lit.
    """
    by_range = np.array_split(np.argsort(z, kind="stable"), min(BINS, max(1, len(z))))
    medians = np.array([np.median(light[members], axis=0) for members in by_range if len(members)])
    ranges = np.array([np.median(z[members]) for members in by_range if len(members)])
    lit = (medians > DARKEST_LIGHT).all(axis=-1)
    if lit.sum() < FEWEST:
        raise NotRestoredError("too little light is left once the backscatter is taken off")
    depths = -np.log(np.minimum(medians[lit], 1.0))
    return np.stack([_fit_attenuation(depth, ranges[lit]) for depth in depths.T])


def _fit_attenuation(
    depth: Array,  # [M] optical depth of one channel
    z: Array,  # [M]
) -> Array:
    def residual(p: Array) -> Array:  # [4] a, b, c, d
        return np.asarray(depth / np.maximum(two_exponentials(p, z), 1e-6) - z)

    rate = float(np.clip(np.median(depth / z), 0.01, 0.45 * LARGEST_RATE))
    lower = np.array([0.0, -STEEPEST, 0.0, -STEEPEST])
    upper = np.array([LARGEST_RATE, 0.0, LARGEST_RATE, 0.0])
    fit = least_squares(residual, [rate, -0.1, rate, -2.0], bounds=(lower, upper))
    return np.asarray(fit.x)
