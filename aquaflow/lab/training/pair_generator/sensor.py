"""What the camera makes of the light: particles before the lens, exposure, blur, noise, gamma."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.noise import Draw

MEAN_LEVEL = (0.25, 0.55)
"""That automatic exposure aims at."""
UNEVENNESS = 0.2
"""Deviation of the logarithm of a slow brightness pattern: lamps, shadows, vignetting."""
NOISE = (0.002, 0.02)
"""Standard deviation of the noise, in full scale."""
GAMMA = (0.55, 1.1)
"""Exponent of the tone curve."""
BLUR_PX = (0.15, 0.8)
"""Sigma of lens and motion."""
BLUR_TAPS = 7
"""Width of the kernel: 3.75 sigmas of the widest blur to either side."""
SNOW_PER_PIXEL = (-0.003, 0.002)
"""Bright particles; none where the draw is negative."""


def take_picture(
    draw: Draw,
    radiance: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 3, H, W] in [0, 1]: the picture, each with its own exposure and white balance."""
    image = _expose(draw, radiance * _uneven(draw, radiance))
    image = _blur(draw, image + _snow(draw, image))
    batch = len(image)
    image = image + draw.normal(*image.shape) * draw.log_uniform(
        batch, 1, 1, 1, low=NOISE[0], high=NOISE[1]
    )
    image = image.clamp(1e-4, 1.0) ** draw.uniform(batch, 1, 1, 1, low=GAMMA[0], high=GAMMA[1])
    return (image * (1.0 + draw.normal(batch, 3, 1, 1, sigma=0.06))).clamp(0.0, 1.0)


def _expose(
    draw: Draw,
    image: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """Mean level as automatic exposure wants it, white balance from none to complete."""
    batch = len(image)
    mean = image.mean(dim=(2, 3), keepdim=True).clamp_min(0.02)
    balance = draw.uniform(batch, 1, 1, 1)
    level = draw.uniform(batch, 1, 1, 1, low=MEAN_LEVEL[0], high=MEAN_LEVEL[1])
    return image * level / torch.lerp(mean.mean(1, keepdim=True), mean, balance)


def _uneven(
    draw: Draw,
    image: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 1, H, W] gain."""
    coarse = draw.normal(len(image), 1, 4, 5) * draw.uniform(len(image), 1, 1, 1, high=UNEVENNESS)
    return F.interpolate(coarse, size=image.shape[-2:], mode="bicubic", align_corners=False).exp()


def _snow(
    draw: Draw,
    image: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 1, H, W] light of particles that drift by, out of focus to a degree of their own."""
    batch, _, height, width = image.shape
    share = draw.uniform(batch, 1, 1, 1, low=SNOW_PER_PIXEL[0], high=SNOW_PER_PIXEL[1])
    there = (draw.uniform(batch, 1, height, width) < share).float()
    light = there * draw.uniform(batch, 1, height, width) ** 2
    light = light * draw.uniform(batch, 1, 1, 1, low=0.2, high=1.2)
    far = F.avg_pool2d(light, 3, 1, 1) * 3.0
    near = F.avg_pool2d(far.roll((7, 5), (-2, -1)), 5, 1, 2) * draw.uniform(batch, 1, 1, 1, high=4)
    return light + far + near


def _blur(
    draw: Draw,
    image: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """By an elongated Gaussian of its own for each picture: defocus, water, motion."""
    batch, channels, height, width = image.shape
    sigma = draw.uniform(batch, 1, 1, low=BLUR_PX[0], high=BLUR_PX[1])
    across = sigma * draw.uniform(batch, 1, 1, low=0.3, high=1.0)
    angle = draw.uniform(batch, 1, 1, high=math.pi)
    axis = torch.arange(BLUR_TAPS, device=image.device) - BLUR_TAPS // 2
    x, y = axis[None, None].float(), axis[None, :, None].float()
    u, v = x * angle.cos() + y * angle.sin(), y * angle.cos() - x * angle.sin()
    kernel = torch.exp(-0.5 * ((u / sigma) ** 2 + (v / across) ** 2))
    kernel = kernel / kernel.sum(dim=(1, 2), keepdim=True)
    kernels = kernel[:, None].repeat_interleave(channels, 0)
    flat = image.reshape(1, batch * channels, height, width)
    half = BLUR_TAPS // 2
    padded = F.pad(flat, (half, half, half, half), mode="reflect")
    return F.conv2d(padded, kernels, groups=batch * channels).view_as(image)
