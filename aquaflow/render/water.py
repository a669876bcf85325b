"""The picture through the water, fused with its gradient (paper, Eq. 12 and 15).

    I = J exp(-beta z) + a (B_inf (1 - exp(-b z)) + B_res exp(-d z)) + (1 - a) B_inf

J is premultiplied by alpha a. Where the map has no geometry the ray goes on to infinity, and what
it sees there is B_inf; where a = 1 this is the paper's equation.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from aquaflow.render.library import Library, library_or_none, pointer

MAX_OPTICAL_DEPTH = 8.0
"""exp(-8) = 3e-4 is below a tenth of a grey level in 256: beyond it nothing changes any more."""

MIN_SOLID = 1e-3
"""Guards range / alpha; below this alpha nothing was drawn."""


def compose_water_torch(
    drawn: Tensor,  # [H, W, 4] premultiplied radiance and accumulated range
    alpha: Tensor,  # [H, W]
    water: Tensor,  # [5, 3] beta, B_inf, b, B_res, d
) -> tuple[Tensor, Tensor]:
    """The definition, in the inputs' dtype: oracle and fallback. Image [H, W, 3], range [H, W]."""
    beta, B_inf, b, B_res, d = water
    z = drawn[..., 3] / alpha.clamp_min(MIN_SOLID)
    a, path = alpha[..., None], z[..., None]
    T, far, near = (
        torch.exp(-(rate * path).clamp(0.0, MAX_OPTICAL_DEPTH)) for rate in (beta, b, d)
    )
    image = drawn[..., :3] * T + B_inf * (1.0 - a * far) + a * B_res * near
    return image, z


def compose_water(
    drawn: Tensor,  # [H, W, 4] premultiplied radiance and accumulated range
    alpha: Tensor,  # [H, W]
    water: Tensor,  # [5, 3] beta, B_inf, b, B_res, d; rates per unit of range
    threads: int | None = None,
) -> tuple[Tensor, Tensor]:
    """Image [H, W, 3] through the water and range [H, W]; differentiable in all three inputs."""
    library = library_or_none() if drawn.device.type == "cpu" else None
    if library is None:
        return compose_water_torch(drawn, alpha, water)
    threads = threads if threads is not None else torch.get_num_threads()
    plain = [tensor.to(torch.float32).contiguous() for tensor in (drawn, alpha, water)]
    image, z = _ComposeWater.apply(*plain, threads, library)  # type: ignore[no-untyped-call]
    return image, z


class _ComposeWater(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        drawn: Tensor,  # [H, W, 4] premultiplied colour and range
        alpha: Tensor,  # [H, W]
        water: Tensor,  # [5, 3]
        threads: int,
        library: Library,
    ) -> tuple[Tensor, Tensor]:
        height, width = alpha.shape
        image, z = torch.empty(height, width, 3), torch.empty(height, width)
        inputs = (pointer(drawn), pointer(alpha), pointer(water), height * width, threads)
        library.call("aq_compose_water", *inputs, pointer(image), pointer(z))
        ctx.save_for_backward(drawn, alpha, water)
        ctx.threads, ctx.library = threads, library
        return image, z

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        g_image: Tensor,  # [H, W, 3]
        g_z: Tensor,  # [H, W]
    ) -> tuple[Any, ...]:
        drawn, alpha, water = ctx.saved_tensors
        incoming = (g_image.contiguous(), g_z.contiguous())
        gradients = [torch.empty_like(tensor) for tensor in (drawn, alpha, water)]
        inputs = (pointer(drawn), pointer(alpha), pointer(water), alpha.numel(), ctx.threads)
        outputs = map(pointer, (*incoming, *gradients))
        ctx.library.call("aq_compose_water_backward", *inputs, *outputs)
        return (*gradients, None, None)
