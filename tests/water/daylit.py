"""A grey surface by the daylight that is left at a depth, worked out apart from the code."""

from __future__ import annotations

import math

from aquaflow.water.white_balance import Rgb

OCEANIC_II = {
    400: 0.096, 425: 0.081, 450: 0.068, 475: 0.062, 500: 0.07, 525: 0.076, 550: 0.089,
    575: 0.115, 600: 0.26, 625: 0.335, 650: 0.4, 675: 0.465, 700: 0.61,
}  # fmt: skip
"""K_d, 1/m, by wavelength in nm: Jerlov 1976, Table XXVII."""


def daylit_grey(depth_m: float) -> Rgb:
    """RGB as encoded, over that at the surface."""
    red, green, blue = (_channel(middle, depth_m) for middle in (600, 535, 465))
    return red, green, blue


def _channel(middle_nm: int, depth_m: float) -> float:
    light = all_of_it = 0.0
    for nm in range(400, 700):
        below = nm - nm % 25
        share = (nm - below) / 25.0
        K_d = (1.0 - share) * OCEANIC_II[below] + share * OCEANIC_II[below + 25]
        seen = math.exp(-0.5 * ((nm - middle_nm) / 30.0) ** 2)
        light += seen * math.exp(-K_d * depth_m)
        all_of_it += seen
    return float((light / all_of_it) ** (1.0 / 2.2))
