"""What was seen nearest, whose colours restored pictures keep."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.water.model import Trial, WaterModel
from aquaflow.water.observations import PICTURES_AT_ONCE, Observations
from aquaflow.water.open_sightings import WINDOW_PX, open_area
from aquaflow.water.sightings import PosedPicture
from aquaflow.water.white_balance import WhiteBalance

Array = npt.NDArray[np.float64]

SHARE = 0.1
"""Of the surface in each view, the nearest, whose mean colour is kept."""
LEAST_MEAN = 1e-3
"""Guards the division by a channel that is black."""
GAINS = 0.05, 2.0
"""Bounds of the gain of J: red at a twentieth is three optical depths away."""


@dataclass(frozen=True)
class Nearest:
    """What each view shows nearest."""

    view: npt.NDArray[np.int64]
    """[N]"""
    xy: Array
    """[N, 2] where in the picture, each axis from -1 to 1."""
    z: Array
    """[N] range, map units."""
    colour: Array
    """[N, 3] as the camera saw it."""


def nearest_of(
    seen: Observations,
    pictures: Sequence[PosedPicture],
    trial: Trial,
    mean: Array,  # [3] of the scene without that water
) -> Generator[None, None, Nearest]:
    """In the pictures, open water left out; of the observations, where no picture shows any; with
    pauses."""
    found = []
    for number in range(min(len(pictures), len(trial.exposure))):
        found.append(_in_picture(pictures[number], trial, mean, number))
        if number % PICTURES_AT_ONCE == PICTURES_AT_ONCE - 1:
            yield
    found = [near for near in found if len(near.z)] or [_of_observations(seen)]
    view, xy, z, colour = (
        np.concatenate([getattr(near, name) for near in found])
        for name in ("view", "xy", "z", "colour")
    )
    return Nearest(view, xy, z, colour)


def _in_picture(
    picture: PosedPicture,
    trial: Trial,
    mean: Array,  # [3]
    view: int,
) -> Nearest:
    image, z = picture.half_size(), picture.surface_ranges()
    # Where open water ends there is texture in the window, but no surface yet.
    window = np.ones((2 * WINDOW_PX, 2 * WINDOW_PX), np.uint8)
    is_open = cv2.dilate(open_area(picture, trial, mean, view).astype(np.uint8), window) > 0
    z = np.where(is_open, np.float32(np.inf), z)
    known = np.isfinite(z)
    limit = np.quantile(z[known], SHARE) if known.any() else 0.0
    rows, columns = np.nonzero(known & (z <= limit))
    centre = np.stack([columns, rows], axis=-1) + 0.5
    xy = centre / (0.5 * np.array(z.shape[::-1])) - 1.0
    near = z[rows, columns].astype(np.float64), image[rows, columns].astype(np.float64)
    return Nearest(np.full(len(rows), view), xy, *near)


def _of_observations(seen: Observations) -> Nearest:
    limits = [
        np.quantile(z, SHARE) if len(z := seen.z[seen.view == view]) else 0.0
        for view in range(int(seen.view.max()) + 1)
    ]
    near = seen.z <= np.array(limits)[seen.view]
    return Nearest(seen.view[near], seen.xy[near], seen.z[near], seen.colour[near])


def white_balance(
    near: Nearest,
    water: WaterModel,
    trial: Trial,  # of that water
    J: Array,  # [3, P] colours of the scene
    relative_sigma: Sequence[float],  # [3] of the attenuation
) -> WhiteBalance:
    """The white balance by which the mean colour of what is nearest stays as the camera saw it."""
    clean = water.without_water(trial, near.view, near.xy, near.z, near.colour)
    red, green, blue = np.maximum(J.mean(axis=1), LEAST_MEAN).tolist()
    return WhiteBalance(
        float(np.median(near.z)),
        (red, green, blue),
        kept_by(near, clean),
        float(np.mean(relative_sigma)),
    )


def kept_by(
    near: Nearest,
    clean: Array,  # [3, N] without water
) -> tuple[float, float, float]:
    """Gain RGB by which the clean colours have on the mean the camera's."""
    gains = near.colour.mean(axis=0) / np.maximum(clean.mean(axis=1), LEAST_MEAN)
    red, green, blue = np.clip(gains, *GAINS).tolist()
    return red, green, blue
