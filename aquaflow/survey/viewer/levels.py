"""Values of each Gaussian that a browser colours or hides it by: range from the path, coverage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Float = npt.NDArray[np.floating[Any]]
RGB = tuple[int, int, int]

VIRIDIS: tuple[RGB, ...] = (
    (68, 1, 84),
    (59, 82, 139),
    (33, 145, 140),
    (94, 201, 98),
    (253, 231, 37),
)
"""Five colours of it; readable without red and green."""
RANGE = "range"
"""Name of the level that the page hides by."""
MOST_JUDGED = 1 << 18
"""Gaussians that the palette is chosen by; more are thinned."""
MOST_CAMERAS = 5000
"""Poses that ranges are taken from; more are thinned."""


@dataclass(frozen=True)
class Palette:
    """How the 256 values of a level are shown."""

    label: str
    """In the list of colourings."""
    stops: tuple[RGB, ...]
    """Colours; between them are mixtures, unless ``words`` names each of them."""
    words: tuple[str, ...] = ()
    """What values 0, 1, ... mean; empty where values run on from 0 to ``largest``."""
    largest: float = 1.0
    """What 255 stands for."""
    unit: str = ""

    def to_json(self) -> dict[str, Any]:
        """The palette by the names that the page uses."""
        return {
            "label": self.label, "stops": self.stops, "words": self.words,
            "largest": self.largest, "unit": self.unit,
        }  # fmt: skip


class RangeLevel:
    """How far Gaussians lie from the path."""

    def __init__(
        self,
        centres: Float,  # [N, 3] of some Gaussians, by which the palette is chosen
        cameras: Float,  # [M, 3], M > 0
        unit: str,
        metres: float = 1.0,
    ) -> None:
        """Distances are in ``unit``, of which one of the coordinates has ``metres``."""
        self._tree = cKDTree(cameras[:: max(1, -(-len(cameras) // MOST_CAMERAS))])
        distances = self._distances(centres[:: max(1, -(-len(centres) // MOST_JUDGED))])
        largest = float(np.percentile(distances, 99.0)) * 1.25 if len(distances) else 1.0
        self._largest = largest if np.isfinite(largest) and largest > 0.0 else 1.0
        label = "by distance from the path"
        self.palette = Palette(label, VIRIDIS, largest=metres * self._largest, unit=unit)

    def _distances(
        self,
        centres: Float,  # [N, 3]
    ) -> npt.NDArray[np.float64]:
        return np.asarray(self._tree.query(np.nan_to_num(centres))[0])

    def of(
        self,
        centres: Float,  # [N, 3]
    ) -> npt.NDArray[np.uint8]:
        """[N] distance of each Gaussian to the nearest camera."""
        shares = np.clip(self._distances(centres) / self._largest, 0.0, 1.0)
        return np.asarray(np.rint(255.0 * shares), np.uint8)


def range_level(
    centres: Float,  # [N, 3]
    cameras: Float,  # [M, 3], M > 0
    unit: str,
    metres: float = 1.0,
) -> tuple[npt.NDArray[np.uint8], Palette]:
    """The :class:`RangeLevel` of all these Gaussians [N], and its palette."""
    level = RangeLevel(centres, cameras, unit, metres)
    return level.of(centres), level.palette


def steps_level(
    steps: npt.NDArray[np.int32],  # [N]
    often: float,
) -> tuple[npt.NDArray[np.uint8], Palette]:
    """How often [N] each was part of a step of the optimiser, logarithmic up to ``often``."""
    share = np.log1p(np.maximum(steps, 0)) / np.log1p(often)
    values = np.rint(255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
    return values, Palette("by how often it was seen", VIRIDIS, largest=often, unit="times")
