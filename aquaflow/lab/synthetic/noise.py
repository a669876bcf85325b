"""Fractal noise and smooth thresholds: what terrain and textures are made of."""

from __future__ import annotations

import math
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

FloatMap: TypeAlias = npt.NDArray[np.float32]


def fractal(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell_m: float,
    coarsest_m: float,
    finest_m: float,
    roughness: float,
) -> FloatMap:
    """Noise [H, W] with zero mean and unit variance, an octave per factor 2 of wavelength.

    The amplitude of a wavelength grows with its power ``1 - roughness``: 0 is smooth hills, 1 is
    equal contrast at every scale. Random lattices, interpolated: it never repeats.
    """
    total = np.zeros(shape, np.float32)
    power = 0.0
    wavelength = coarsest_m
    while wavelength >= max(finest_m, 2.0 * cell_m) * 0.999:
        # Two lattice points a wavelength; three more so that the border is interpolated too.
        nodes = [max(4, math.ceil(n * cell_m * 2.0 / wavelength) + 3) for n in shape]
        lattice = rng.standard_normal((nodes[0], nodes[1]), dtype=np.float32)
        amplitude = (wavelength / coarsest_m) ** (1.0 - roughness)
        total += np.float32(amplitude) * resize(lattice, shape)
        power += amplitude**2
        wavelength /= 2.0
    # A cubic interpolation of white noise keeps about 0.6 of its variance.
    return total / np.float32(math.sqrt(max(0.6 * power, 1e-12)))


def resize(
    values: npt.NDArray[np.float32],  # [h, w] or [h, w, c]
    shape: tuple[int, int],
) -> FloatMap:
    """``values`` [h, w] or [h, w, c] interpolated to ``shape`` by bicubic splines."""
    out = cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(out, np.float32)


def blur(
    values: FloatMap,  # [h, w]
    sigma_px: float,
) -> FloatMap:
    """Gaussian blur; wide ones are done at reduced resolution, where they cost little."""
    if sigma_px > 8.0:
        height, width = values.shape[:2]
        factor = int(sigma_px // 4)
        size = (max(2, width // factor), max(2, height // factor))
        small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), sigma_px / factor)
        out = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    else:
        out = cv2.GaussianBlur(values, (0, 0), sigma_px)
    return np.asarray(out, np.float32)


def smoothstep(
    values: FloatMap,  # [...]
    low: float,
    high: float,
) -> FloatMap:
    """0 below ``low``, 1 above ``high``, smooth between."""
    x = np.clip((values - np.float32(low)) / np.float32(high - low), 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x), np.float32)
