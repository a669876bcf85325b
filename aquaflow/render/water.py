"""The picture through the water, fused with its gradient (paper, Eq. 12 and 15).

    I = s (J exp(-beta z) + u (a (B_inf (1 - exp(-b z)) + B_res exp(-d z)) + (1 - a) B_inf))

J is premultiplied by alpha a. Where the map has no geometry the ray goes on to infinity, and what
it sees there is B_inf. The paper has no gains: u of the backscatter and s of the camera, at every
pixel; where all three are one this is the paper's equation.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from aquaflow.render.library import Library, library_or_none
from aquaflow.render.tensor_address import pointer

MAX_OPTICAL_DEPTH = 8.0
"""exp(-8) = 3e-4 is below a tenth of a grey level in 256: beyond it nothing changes any more."""

MIN_SOLID = 1e-3
"""Guards range / alpha; below this alpha nothing was drawn."""


def compose_water_torch(
    drawn: Tensor,  # [H, W, 4] premultiplied radiance and accumulated range
    alpha: Tensor,  # [H, W]
    water: Tensor,  # [5, 3] beta, B_inf, b, B_res, d
    uneven: Tensor | None = None,  # [H, W]
    gain: Tensor | None = None,  # [H, W]
) -> tuple[Tensor, Tensor]:
    """The definition, in the inputs' dtype: oracle and fallback. Image [H, W, 3], range [H, W]."""
    beta, B_inf, b, B_res, d = water
    z = drawn[..., 3] / alpha.clamp_min(MIN_SOLID)
    a, path = alpha[..., None], z[..., None]
    T, far, near = (
        torch.exp(-(rate * path).clamp(0.0, MAX_OPTICAL_DEPTH)) for rate in (beta, b, d)
    )
    veil = B_inf * (1.0 - a * far) + a * B_res * near
    image = drawn[..., :3] * T + (veil if uneven is None else uneven[..., None] * veil)
    return (image if gain is None else gain[..., None] * image), z


def compose_water(
    drawn: Tensor,  # [H, W, 4] premultiplied radiance and accumulated range
    alpha: Tensor,  # [H, W]
    water: Tensor,  # [5, 3] beta, B_inf, b, B_res, d; rates per unit of range
    threads: int | None = None,
    uneven: Tensor | None = None,  # [H, W] gain of the backscatter; None: one
    gain: Tensor | None = None,  # [H, W] gain of the camera; None: one
) -> tuple[Tensor, Tensor]:
    """Image [H, W, 3] through the water and range [H, W]; differentiable in the first three."""
    gains = [None if plane is None else plane.detach() for plane in (uneven, gain)]
    library = library_or_none() if drawn.device.type == "cpu" else None
    if library is None:
        return compose_water_torch(drawn, alpha, water, *gains)
    threads = threads if threads is not None else torch.get_num_threads()
    plain = [
        None if tensor is None else tensor.to(torch.float32).contiguous()
        for tensor in (drawn, alpha, water, *gains)
    ]
    image, z = _ComposeWater.apply(*plain, threads, library)  # type: ignore[no-untyped-call]
    return image, z


def _address(
    plane: Tensor | None,  # [H, W]
) -> int | None:
    return None if plane is None else pointer(plane)


class _ComposeWater(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        drawn: Tensor,  # [H, W, 4] premultiplied colour and range
        alpha: Tensor,  # [H, W]
        water: Tensor,  # [5, 3]
        uneven: Tensor | None,  # [H, W]
        gain: Tensor | None,  # [H, W]
        threads: int,
        library: Library,
    ) -> tuple[Tensor, Tensor]:
        height, width = alpha.shape
        image, z = torch.empty(height, width, 3), torch.empty(height, width)
        inputs = map(_address, (drawn, alpha, water, uneven, gain))
        outputs = (pointer(image), pointer(z))
        library.call("aq_compose_water", *inputs, height * width, threads, *outputs)
        ctx.save_for_backward(drawn, alpha, water, uneven, gain)
        ctx.threads, ctx.library = threads, library
        return image, z

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        g_image: Tensor,  # [H, W, 3]
        g_z: Tensor,  # [H, W]
    ) -> tuple[Any, ...]:
        drawn, alpha, water, uneven, gain = ctx.saved_tensors
        incoming = (g_image.contiguous(), g_z.contiguous())
        gradients = [torch.empty_like(tensor) for tensor in (drawn, alpha, water)]
        inputs = map(_address, (drawn, alpha, water, uneven, gain))
        outputs = map(pointer, (*incoming, *gradients))
        size = (alpha.numel(), ctx.threads)
        ctx.library.call("aq_compose_water_backward", *inputs, *size, *outputs)
        return (*gradients, None, None, None, None)


# --------------------------------------------------------------------------------------------------
# The sinusoidal encoding gamma of the paper (Eq. 7).

BANDS = 4
"""L in the paper."""


def sinusoidal_encoding(
    x: Tensor,  # [..., D]
    bands: int = BANDS,
) -> Tensor:
    """[..., D (1 + 2 L)]: x, then sin and cos of 2^l pi x for l below ``bands``."""
    parts = [x]
    for level in range(bands):
        angle = (2.0**level * math.pi) * x
        parts += [torch.sin(angle), torch.cos(angle)]
    return torch.cat(parts, dim=-1)
