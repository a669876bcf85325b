"""Do restored pictures look natural? What is nearest to the camera must keep its colours.

There is hardly any water before what is nearest, so its restored colour should be the camera's. No
truth is needed. Colours are compared in CIELAB, of the pictures as they are shown on a screen: as
sRGB, which is how cameras encode them (docs/conventions.md#pictures).

The hue is the direction of the mean a* and b*. It means nothing for grey, which has none: a view
whose camera picture has less than ``LEAST_CHROMA`` there counts for the chroma difference, in which
a cast shows as well, but not for the hue.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.lab.evaluation.held_out import (
    held_out_indices,
    read_picture,
    read_range,
    read_restored_area,
)
from aquaflow.water.tone import cielab

NEAREST_SHARE = 0.1
"""Share of a view's restored pixels that is compared."""
LEAST_CHROMA = 5.0
"""CIELAB units; what has less looks grey, and noise turns its hue."""


@dataclass(frozen=True)
class Naturalness:
    """Restored against camera colours of the nearest pixels, mean over held-out views."""

    views: int
    hue_views: int
    """Views whose nearest pixels have a hue."""
    hue_shift_deg: float | None
    """Angle between the mean a*b* of both; None if no view has a hue."""
    largest_hue_shift_deg: float | None
    """Of one view."""
    chroma_difference: float
    """Restored minus camera, CIELAB units."""
    lightness_ratio: float
    """L* restored over L* of the camera's picture."""

    def to_json(self) -> dict[str, Any]:
        """Stable keys."""
        return asdict(self)


def evaluate_naturalness(dive: Path) -> Naturalness | None:
    """Compare the nearest pixels of each restored held-out view; None without such views.

    Raises:
        InputError: a picture or range of the dive cannot be read, or they differ in size.
    """
    compared = [
        nearest
        for index in held_out_indices(dive, "restored")
        if (nearest := _nearest_colours(dive, index)) is not None
    ]
    if not compared:
        return None
    real, restored = np.stack(compared, axis=1)
    chroma, restored_chroma = (np.linalg.norm(lab[:, 1:], axis=1) for lab in (real, restored))
    coloured = chroma >= LEAST_CHROMA
    shifts = _angles_deg(real[coloured, 1:], restored[coloured, 1:])
    return Naturalness(
        views=len(compared),
        hue_views=len(shifts),
        hue_shift_deg=float(shifts.mean()) if len(shifts) else None,
        largest_hue_shift_deg=float(shifts.max()) if len(shifts) else None,
        chroma_difference=float((restored_chroma - chroma).mean()),
        lightness_ratio=float((restored[:, 0] / np.maximum(real[:, 0], 1.0)).mean()),
    )


def _nearest_colours(dive: Path, index: int) -> npt.NDArray[np.float64] | None:
    """[2, 3] mean L*, a*, b* of the nearest pixels: camera, restored; None if none is solid."""
    z = read_range(dive, index)
    real, _ = read_picture(dive, index, "real")
    restored, opaque = read_picture(dive, index, "restored")
    if z is None:
        return None
    if not real.shape == restored.shape == (*z.shape, 3):
        raise InputError(
            f"the pictures and ranges of held-out frame {index} in {dive} differ in size; map the "
            "dive again"
        )
    solid, area = (z > 0.0) & opaque, read_restored_area(dive, index)
    if area is not None and area.shape == solid.shape:
        solid &= area
    if not solid.any():
        return None
    nearest = solid & (z <= np.quantile(z[solid], NEAREST_SHARE))
    pictures = (picture.astype(np.float32) / np.float32(255.0) for picture in (real, restored))
    return np.stack([cielab(picture)[nearest].mean(axis=0) for picture in pictures])


def _angles_deg(
    a: npt.NDArray[np.float64],  # [N, 2]
    b: npt.NDArray[np.float64],  # [N, 2]
) -> npt.NDArray[np.float64]:
    """[N] between the vectors, from 0 to 180."""
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.asarray(np.abs(np.degrees(np.arctan2(cross, (a * b).sum(axis=1)))), np.float64)
