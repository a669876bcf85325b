"""How well each place of a map was seen, by the classes of :mod:`aquaflow.coverage`.

A finished dive keeps no ranges of its keyframes, so that places count as seen by every keyframe
that has them in its picture; what stands before them is not known. Places are cubes of the map.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.config.coverage import CoverageConfig
from aquaflow.coverage.classes import COLOURS, WORDS, Seen, classified
from aquaflow.coverage.raster import DIRECTION_BINS, direction_bins
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.viewer.levels import Palette

Array = npt.NDArray[np.float64]
Levels = npt.NDArray[np.uint8]

COVERAGE = "coverage"
"""Name of the level."""
UNSEEN = (60, 60, 66)
"""RGB of what was not seen: dark, as it is missing."""
CLASSES = Palette(
    "by coverage",
    tuple(COLOURS.get(seen, UNSEEN) for seen in Seen),
    tuple(WORDS[seen] for seen in Seen),
)
MOST_PLACES = 16_384
"""Cubes; twice the size along each side where there would be more."""
FIRST_CELLS = 256
"""Along the map's longest side, to begin with."""
MOST_VIEWS = 2000
"""Keyframes that are counted, evenly chosen of more."""


def coverage_level(
    centres: npt.NDArray[np.floating],  # [N, 3]
    views: list[Sim3],  # T_wc
    camera: CameraModel,
    up: Array,  # [3] unit
    limit: float | None,
    config: CoverageConfig,
    most_places: int = MOST_PLACES,
) -> Levels:
    """[N] a :class:`aquaflow.coverage.Seen` for each Gaussian; ``limit``: the range beyond which it
    is too far for the water, None where nothing limits."""
    if not len(centres):
        return np.zeros(0, np.uint8)
    places, of = _places(np.nan_to_num(np.asarray(centres, np.float64)), most_places)
    by_range = np.zeros((len(places), 2), np.uint16)
    by_direction = np.zeros((len(places), DIRECTION_BINS), np.uint8)
    index, R_gm = np.arange(len(places)), _upright(up)
    for T_wc in views[:: max(1, -(-len(views) // MOST_VIEWS))]:
        seen, ranges, sides = _looked_at(places, T_wc, camera, R_gm)
        far = (ranges > (np.inf if limit is None else limit)).astype(int)
        by_range[index[seen], far] += 1
        by_direction[index[seen], sides] = 1
    found = classified(by_range, by_direction, near=1, config=config)
    return np.asarray(found[of], np.uint8)


def _places(
    centres: Array,  # [N, 3]
    most: int,
) -> tuple[Array, npt.NDArray[np.intp]]:
    """Centres [M, 3] of the cubes that hold any, and the cube [N] of each."""
    low, high = np.percentile(centres, (1.0, 99.0), axis=0)
    side = max(float((high - low).max()), 1e-9) / FIRST_CELLS
    while True:
        cells = np.floor(np.clip(centres - low, -1e4 * side, 1e4 * side) / side).astype(np.int64)
        keys = (cells[:, 0] * 40_000 + cells[:, 1]) * 40_000 + cells[:, 2]
        _, first, of = np.unique(keys, return_index=True, return_inverse=True)
        if len(first) <= most:
            return centres[first], of.ravel()
        side *= 2.0


def _looked_at(
    places: Array,  # [M, 3]
    T_wc: Sim3,
    camera: CameraModel,
    R_gm: Array,  # [3, 3] to axes of which z points up
) -> tuple[npt.NDArray[np.bool_], Array, npt.NDArray[np.int64]]:
    """Which [M] are in the picture; of these the range, and the direction that they are seen from,
    as aquaflow/coverage counts them."""
    away = places - T_wc.t
    x, y, z = (away @ T_wc.R).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    seen = (z > 0.0) & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
    back = -away[seen]
    return seen, np.linalg.norm(back, axis=1), direction_bins(back @ R_gm.T)


def _upright(
    up: Array,  # [3] unit
) -> Array:
    """[3, 3] to axes of which z points up."""
    other = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    one = np.cross(up, other)
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(up, one), up])
