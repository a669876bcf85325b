"""Running statistics of a picture's gradients: which of them stay while the scene moves."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]

MEMORY = 20.0
"""Samples that the statistics remember: a display that is switched off is forgotten after them."""
NOISE = 3.0
"""Grey levels per pixel: gradients of sensor noise and compression, which stay by chance."""
CHANCE = 1e-4
"""Probability with which a gradient of the moving scene may pass for one that stays."""
LEAST_COHERENCE = 0.6
"""However many samples there are: a semi-transparent logo keeps more."""
CHARACTER_PX = 9
"""Width of a digit at 480 px: in a square of this size a text has a stroke in every picture."""


class StaticStructure:
    """Moments of the gradient at every pixel, over pictures of different parts of the scene.

    The coherent power |mean g|^2 / mean |g|^2 is 1 for a gradient that stays and 1 / n on average
    for n random ones; one strong edge that passed once does not raise it.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        """``shape``: rows, columns."""
        self._gx: Float = np.zeros(shape, np.float32)
        self._gy: Float = np.zeros(shape, np.float32)
        self._power: Float = np.zeros(shape, np.float32)
        self._weight = self._squares = 0.0
        self.persistent: Float = np.full(shape, np.inf, np.float32)
        """[H, W] least contrast of any sample in a character's surroundings."""

    def add(
        self,
        grey: Float,  # [H, W]
    ) -> None:
        """One sample; earlier ones fade."""
        gx, gy = gradients(grey)
        power = gx * gx + gy * gy
        keep = 1.0 - 1.0 / MEMORY
        totals, values = (self._gx, self._gy, self._power), (gx, gy, power)
        self._gx, self._gy, self._power = (
            np.asarray(cv2.addWeighted(total, keep, value, 1.0, 0.0), dtype=np.float32)
            for total, value in zip(totals, values, strict=True)
        )
        self._weight = keep * self._weight + 1.0
        self._squares = keep * keep * self._squares + 1.0
        near = cv2.dilate(np.sqrt(power), np.ones((CHARACTER_PX, CHARACTER_PX), np.uint8))
        # It fades upwards as the sums do, so that one picture of the past is not for ever.
        self.persistent = np.minimum(self.persistent * np.float32(1.0 / keep), near)

    @property
    def samples(self) -> float:
        """Effective number of samples."""
        return self._weight**2 / max(self._squares, 1e-12)

    @property
    def mean(self) -> tuple[Float, Float]:
        """[H, W] each, mean gradient along x and y, grey levels per pixel."""
        scale = np.float32(1.0 / self._weight)
        return self._gx * scale, self._gy * scale

    @property
    def power(self) -> Float:
        """[H, W] mean squared gradient."""
        return np.asarray(self._power / self._weight, np.float32)

    @property
    def coherence(self) -> Float:
        """[H, W] coherent share of the power, 0 to 1."""
        mx, my = self.mean
        return np.asarray((mx * mx + my * my) / (self.power + NOISE**2), np.float32)

    @property
    def least_coherence(self) -> float:
        """What a random gradient exceeds with the probability ``CHANCE``.

        Of n independent complex normal gradients the coherent share exceeds t with the probability
        (1 - t)^(n - 1).
        """
        by_chance = 1.0 - CHANCE ** (1.0 / max(self.samples - 1.0, 1e-3))
        return max(LEAST_COHERENCE, float(by_chance))


def gradients(
    grey: Float,  # [H, W]
) -> tuple[Float, Float]:
    """Along x and y, per pixel."""
    gx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125)
    return np.asarray(gx), np.asarray(gy)
