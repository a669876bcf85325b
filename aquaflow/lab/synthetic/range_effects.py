"""What water does to a picture with range that the image formation of water.py cannot say.

Blur: light that is scattered by small angles on its way arrives beside where it came from. The
variance of its angle grows in proportion to the path (Wells, "Theory of small angle scattering",
AGARD Lecture Series 61, 1973), so a point is spread to a Gaussian whose width grows with the root
of the range. The share that is not scattered at all is left out.

Colour: a channel is as wide as a band of wavelengths, and what is attenuated most goes first, so
the attenuation of what is left falls with range (Akkaynak and Treibitz, "A revised underwater image
formation model", CVPR 2018). Where attenuation is gamma-distributed over the band, with mean
beta_a and standard deviation s beta_a, the transmission is

    mean of exp(-beta z) = (1 + s^2 beta_a z)^(-1 / s^2)

which is exp(-beta_a z) for s = 0, and falls at beta_a / (1 + s^2 beta_a z).
"""

from __future__ import annotations

import math
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.config import RangeEffects
from aquaflow.lab.synthetic.render import RenderedView
from aquaflow.lab.synthetic.water import Medium

Image: TypeAlias = npt.NDArray[np.float32]

STEP_PX = 0.4
"""Between the widths of blur that a picture is computed with; those between are interpolated."""


def with_range_effects(
    view: RenderedView,
    medium: Medium,
    focal_px: float,
    effects: RangeEffects,
) -> Image:
    """``view.water`` [H, W, 3] with what ``effects`` add by each pixel's range."""
    z = np.where(np.isfinite(view.range_m), view.range_m, 0.0).astype(np.float32)
    change = wideband_transmission(medium, z, effects.band_spread) - medium.transmission(z)
    seen = (view.water + view.clean * change).astype(np.float32)
    return spread(seen, np.float32(focal_px) * effects.blur_rad(z))


def wideband_transmission(
    medium: Medium,
    z: Image,  # [...] m
    band_spread: tuple[float, float, float],
) -> Image:
    """[..., 3] share of J that is seen; ``band_spread`` is the s of the module's text."""
    s2 = np.maximum(np.square(band_spread), 1e-6)
    return np.asarray((1.0 + s2 * np.asarray(medium.beta_a) * z[..., None]) ** (-1.0 / s2), z.dtype)


def spread(
    picture: Image,  # [H, W, 3]
    sigma_px: Image,  # [H, W]
) -> Image:
    """Each pixel [H, W, 3] as a Gaussian of its own width sees it."""
    level = sigma_px[..., None] / np.float32(STEP_PX)
    blurred = np.zeros_like(picture)
    for k in range(math.ceil(float(level.max())) + 1):
        share = np.clip(1.0 - np.abs(level - k), 0.0, 1.0)
        blurred += share * (cv2.GaussianBlur(picture, (0, 0), k * STEP_PX) if k else picture)
    return blurred
