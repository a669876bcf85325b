"""The underwater dark channel prior (Drews et al., ICCV workshops 2013; IEEE CG&A 36(2), 2016).

Near a camera something is dark in green or blue. So the darkest green or blue value nearby, over
that of open water, is the share of the light that the water adds; no range is needed.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.lab.evaluation.water_peers.contract import NotRestoredError, Pictures, Ranges

Plane = npt.NDArray[np.float32]
"""[H, W]"""

PATCH_PX = 15
"""Width of the neighbourhood whose darkest value counts."""
BRIGHTEST = 0.001
"""Share of pixels, those with the brightest dark channel, that show open water."""
LEAST_TRANSMISSION = 0.1
"""What returns less light is not amplified further."""
DARKEST_WATER = 1.0 / 255.0
"""Open water below one step of 8 bits is no divisor."""
GUIDE_RADIUS_PX, GUIDE_VARIANCE = 30, 1e-3
"""Of the guided filter that fits the transmission to the picture's edges."""


def restore(
    pictures: Pictures,  # [N, H, W, 3] in [0, 1]
    ranges: Ranges | None,  # [N, H, W], not used
) -> Pictures:
    """Restore every picture from itself alone.

    Raises:
        NotRestoredError: a picture is too dark to show the water's colour.
    """
    return np.stack([_restore(picture) for picture in pictures])


def _restore(
    picture: Plane,  # [H, W, 3] in [0, 1]
) -> Plane:
    water = _open_water(picture)
    if not (water[1:] > DARKEST_WATER).all():
        raise NotRestoredError("a picture is too dark to show the colour of the water")
    # No divisor is small: red, which may be black in water, is no part of the dark channel.
    relative = np.maximum(water, np.float32(DARKEST_WATER))
    coarse = 1.0 - _dark_channel(np.asarray(picture / relative, np.float32))
    guide = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.float32)
    transmission = np.maximum(_guided_filter(coarse, guide), LEAST_TRANSMISSION)
    restored = (picture - water) / transmission[..., None] + water
    return np.clip(restored, 0.0, 1.0).astype(np.float32)


def _dark_channel(
    picture: Plane,  # [H, W, 3]
) -> Plane:
    darkest = np.ascontiguousarray(picture[..., 1:].min(axis=-1))
    return np.asarray(cv2.erode(darkest, np.ones((PATCH_PX, PATCH_PX), np.uint8)), np.float32)


def _open_water(
    picture: Plane,  # [H, W, 3]
) -> Plane:
    """[3] colour of the water at infinity."""
    dark = _dark_channel(picture).ravel()
    count = max(1, round(BRIGHTEST * dark.size))
    chosen = np.argpartition(dark, -count)[-count:]
    return np.asarray(picture.reshape(-1, 3)[chosen].mean(axis=0), np.float32)


def _guided_filter(
    values: Plane,  # [H, W]
    guide: Plane,  # [H, W] in [0, 1]
) -> Plane:
    """The guided filter of He, Sun and Tang (ECCV 2010): locally linear in ``guide``."""

    def mean(plane: Plane) -> Plane:  # [H, W]
        size = (2 * GUIDE_RADIUS_PX + 1, 2 * GUIDE_RADIUS_PX + 1)
        return np.asarray(cv2.blur(plane, size), np.float32)

    mean_guide, mean_values = mean(guide), mean(values)
    covariance = mean(guide * values) - mean_guide * mean_values
    variance = mean(guide * guide) - mean_guide * mean_guide
    slope = np.asarray(covariance / (np.maximum(variance, 0.0) + GUIDE_VARIANCE), np.float32)
    return mean(slope) * guide + mean(mean_values - slope * mean_guide)
