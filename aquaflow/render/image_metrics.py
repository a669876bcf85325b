"""Picture quality: PSNR, SSIM, LPIPS and, for restored colours, PSNR after a gain per channel."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.floating]
Mask = npt.NDArray[np.bool_]

PSNR_LIMIT_DB = 100.0
"""Reported for equal pictures, whose PSNR is infinite and has no JSON number."""

LPIPS_BACKBONE = "vgg16-397923af.pth"
"""The file that torchvision keeps in torch's hub folder."""


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


def lpips(
    image: Image,  # [H, W, 3] in [0, 1]
    reference: Image,  # [H, W, 3] in [0, 1]
) -> tuple[float | None, str | None]:
    """LPIPS (VGG) and None, or None and the reason why it cannot be measured here.

    Nothing is downloaded: a vehicle's computer has no network, and a metric must not need one.
    """
    network, reason = lpips_network()
    if network is None:
        return None, reason
    import torch

    def tensor(picture: Image) -> torch.Tensor:  # [1, 3, H, W] in [-1, 1]
        return torch.from_numpy(picture.astype(np.float32)).permute(2, 0, 1)[None] * 2.0 - 1.0

    with torch.no_grad():
        return float(network(tensor(image), tensor(reference))), None


@functools.lru_cache(maxsize=1)
def lpips_network() -> tuple[Any | None, str | None]:
    """The LPIPS network and None, or None and the reason why there is none."""
    try:
        import lpips as package  # type: ignore[import-not-found]
    except ImportError:
        return None, "the Python package 'lpips' is not installed"
    import torch

    weights = Path(torch.hub.get_dir()) / "checkpoints" / LPIPS_BACKBONE
    if not weights.is_file():
        return None, f"the VGG weights of LPIPS are not at {weights}"
    return package.LPIPS(net="vgg", verbose=False).eval(), None
