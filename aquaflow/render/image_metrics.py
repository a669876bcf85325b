"""Picture quality: PSNR, SSIM, FLIP and, for restored colours, PSNR after a gain per channel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.floating]
Mask = npt.NDArray[np.bool_]

PSNR_LIMIT_DB = 100.0
"""Reported for equal pictures, whose PSNR is infinite and has no JSON number."""


def psnr(
    image: Image,  # [H, W, 3] in [0, 1]
    reference: Image,  # [H, W, 3] in [0, 1]
    mask: Mask | None = None,  # [H, W], True where the pixel counts
) -> float:
    """Peak signal-to-noise ratio in dB, at most ``PSNR_LIMIT_DB``; zero counted pixels give 0."""
    difference = (image.astype(np.float64) - reference.astype(np.float64)) ** 2
    counted = difference if mask is None else difference[mask]
    if counted.size == 0:
        return 0.0
    error = max(float(counted.mean()), 10.0 ** (-PSNR_LIMIT_DB / 10.0))
    return -10.0 * float(np.log10(error))


def channel_gain(
    image: Image,  # [..., 3]
    reference: Image,  # [..., 3]
    mask: Mask | None = None,  # [...], True where the pixel counts
) -> npt.NDArray[np.float64]:
    """[3] factors on ``image`` that bring it closest to ``reference``; 0 for a black channel."""
    counted = Ellipsis if mask is None else mask
    xs, ys = (picture.astype(np.float64)[counted].reshape(-1, 3) for picture in (image, reference))
    energy = (xs * xs).sum(axis=0)
    return np.asarray((xs * ys).sum(axis=0) / np.maximum(energy, np.finfo(np.float64).tiny))


def ssim(
    image: Image,  # [H, W, 3] in [0, 1]
    reference: Image,  # [H, W, 3] in [0, 1]
) -> float:
    """Structural similarity as the mapper's loss defines it (Wang et al. 2004): 11 x 11 Gaussian,
    zeros outside; by OpenCV, which takes a tenth of the time of torch's convolutions."""
    import cv2

    from aquaflow.render.photometric import SSIM_C1, SSIM_C2, SSIM_SIGMA_PX, SSIM_WINDOW

    window = cv2.getGaussianKernel(SSIM_WINDOW, SSIM_SIGMA_PX)

    def window_mean(picture: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        filtered = cv2.sepFilter2D(
            picture, cv2.CV_64F, window, window, borderType=cv2.BORDER_CONSTANT
        )
        return np.asarray(filtered, dtype=np.float64)

    a, b = image.astype(np.float64), reference.astype(np.float64)
    mu_a, mu_b = window_mean(a), window_mean(b)
    both = mu_a * mu_a + mu_b * mu_b
    variances = window_mean(a * a + b * b) - both
    covariance = window_mean(a * b) - mu_a * mu_b
    luminance = (2.0 * mu_a * mu_b + SSIM_C1) / (both + SSIM_C1)
    return float((luminance * (2.0 * covariance + SSIM_C2) / (variances + SSIM_C2)).mean())


def flip(
    image: Image,  # [H, W, 3] in [0, 1]
    reference: Image,  # [H, W, 3] in [0, 1]
) -> float | None:
    """Mean difference that somebody sees who changes between two pictures, 0 to 1 (FLIP, Andersson
    et al. 2020, at 67 pixels for each degree); None where its package is not installed."""
    try:
        import flip_evaluator  # type: ignore[import-untyped,unused-ignore]
    except ImportError:
        return None
    pictures = (np.ascontiguousarray(each, np.float32) for each in (reference, image))
    seen, _, _ = flip_evaluator.evaluate(*pictures, "LDR", applyMagma=False)
    return float(np.asarray(seen, np.float64).mean())
