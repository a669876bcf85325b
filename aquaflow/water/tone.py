"""The tone of restored pictures: one gain for a dive, and highlights drawn together."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

Array = npt.NDArray[np.float64]

BRIGHT_QUANTILE, BRIGHT_LEVEL = 0.995, 0.95
"""This share of the restored pixels is shown no brighter than this level."""
KNEE = 0.8
"""Shown value above which highlights are drawn together, if they have to be. Held-out views of IUI3
against their owners' restoration: 25.0 dB with 0.8, 24.8 with 0.6."""
MOST_EXPOSURE, MOST_PEAK = 8.0, 1.25
"""Three stops; and how far beyond white an exposure may take highlights, which are drawn together
then: of IUI3's sand hardly any texture was left at 1.4."""


@dataclass(frozen=True)
class ShownTone:
    """How the clean radiance becomes what a person looks at: one gain, and highlights that would be
    cut off drawn together, smoothly from ``KNEE`` on."""

    exposure: float = 1.0
    compression: float = 0.0
    """c of shown = KNEE + x / (1 + c x) for x, a value times ``exposure``, less KNEE; above it."""

    def of(
        self,
        colours: npt.NDArray[np.floating],  # [...] of the clean radiance
    ) -> npt.NDArray[np.floating]:
        """[...] as shown, mostly in [0, 1]."""
        bright = self.exposure * colours
        above = np.maximum(bright - KNEE, 0.0)
        return np.asarray(np.minimum(bright, KNEE) + above / (1.0 + self.compression * above))


def tone_of(
    seen: Array,  # [n, 3] RGB as the camera saw it
    clear: Array,  # [n, 3] the same without water
) -> ShownTone:
    """For a person to look at: at least as light on the mean as the camera saw the same pixels
    (CIELAB), as far as highlights allow, and these not cut off. Nothing is changed where that is so
    anyway."""
    sound = np.isfinite(seen).all(axis=-1) & np.isfinite(clear).all(axis=-1)
    if not sound.any():
        return ShownTone()
    seen, clear = seen[sound], clear[sound]
    brightest = float(np.quantile(clear.max(axis=-1), BRIGHT_QUANTILE))
    wanted = float(lightness(seen).mean())

    def tone(exposure: float) -> ShownTone:
        peak = exposure * brightest
        if peak <= BRIGHT_LEVEL:
            return ShownTone(exposure)
        return ShownTone(exposure, 1.0 / (BRIGHT_LEVEL - KNEE) - 1.0 / (peak - KNEE))

    def darker(exposure: float) -> float:
        return wanted - float(lightness(tone(exposure).of(clear)).mean())

    if darker(1.0) <= 0.0:
        return tone(1.0)
    most = float(np.clip(MOST_PEAK / max(brightest, 1e-6), 1.0, MOST_EXPOSURE))
    if darker(most) >= 0.0:
        return tone(most)
    return tone(float(brentq(darker, 1.0, most, xtol=1e-3)))


def lightness(
    colours: npt.NDArray[np.floating],  # [..., 3] RGB from 0 to 1, as on a screen (sRGB)
) -> Array:
    """[...] L* of CIELAB, from 0 to 100."""
    return cielab(colours)[..., 0]


def cielab(
    colours: npt.NDArray[np.floating],  # [..., 3] RGB from 0 to 1, as on a screen (sRGB)
) -> Array:
    """[..., 3] L* from 0 to 100, a*, b*."""
    flat = np.clip(colours, 0.0, 1.0).astype(np.float32).reshape(1, -1, 3)
    lab = np.asarray(cv2.cvtColor(flat, cv2.COLOR_RGB2LAB), np.float64)
    return lab.reshape(colours.shape)
