"""Open water in a picture: nothing but backscatter, which ends nowhere.

It has no texture, and the colour of water seen over any length, B_inf. A map has Gaussians there
like anywhere else, at ranges that mean nothing, so the map's alpha does not tell.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]

WINDOW_PX = 9
"""Side of the square in which texture is looked for: a few pixels of the coarsest detail."""
MOST_TEXTURE = 0.012
"""Deviation of the brightness in the window: three grey levels, the noise of compressed video, and
the slow change of the water's own brightness."""
RELATIVE_DIFFERENCE, DIFFERENCE = 0.3, 0.03
"""How far a channel may be from B_inf, relative and absolute: sunlit water is not as bright all
over the picture."""
LEAST_AREA, LEAST_MATCH = 0.01, 0.5
"""Of a connected smooth area: share of the picture, and share of its pixels with that colour."""


def open_water(
    image: Image,  # [H, W, 3] evenly lit
    B_inf: Image,  # [H, W, 3] the backscatter at infinity, as it looks at each pixel
) -> npt.NDArray[np.bool_]:
    """[H, W] True where the picture shows open water."""
    window = (WINDOW_PX, WINDOW_PX)
    grey = image.mean(axis=-1)
    mean = cv2.boxFilter(grey, -1, window)
    variance = cv2.boxFilter(grey * grey, -1, window) - mean * mean
    smooth = variance < MOST_TEXTURE**2
    off = np.abs(cv2.boxFilter(image, -1, window) - B_inf)
    alike = (off < RELATIVE_DIFFERENCE * B_inf + DIFFERENCE).all(axis=-1)
    count, area_of = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=8)
    pixels = np.bincount(area_of.reshape(-1), minlength=count)
    matching = np.bincount(area_of.reshape(-1), alike.reshape(-1), count)
    kept = (pixels > LEAST_AREA * smooth.size) & (matching > LEAST_MATCH * pixels)
    kept[0] = False  # what is not smooth
    return np.asarray(kept[area_of])
