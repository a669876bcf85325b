"""What is drawn of the Gaussians' raw parameters, fused with its gradient.

Scales are exponentials and opacities logistic functions; the radiance J is a softplus, positive and
with a gradient everywhere. The range from the camera is drawn as a fourth colour.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from aquaflow.render.library import Library, library_or_none
from aquaflow.render.tensor_address import pointer

COLOUR_SHARPNESS = 10.0
"""Of the softplus, which is the identity above about 0.3; kSharpness of native/activate.h."""


class RendererInputs(NamedTuple):
    """The arguments of a renderer that follow from raw parameters."""

    scales: Tensor
    """[N, 3] map units."""
    opacities: Tensor
    """[N] in (0, 1)."""
    colours: Tensor
    """[N, 4] clean radiance J, and the range from the camera's centre, map units."""


def radiance(
    raw: Tensor,  # [..., 3]
) -> Tensor:
    """Positive radiance of raw colours."""
    return F.softplus(raw, beta=COLOUR_SHARPNESS)


def activate_torch(
    means: Tensor,  # [N, 3]
    log_scales: Tensor,  # [N, 3]
    opacity_logits: Tensor,  # [N, 1]
    raw_colours: Tensor,  # [N, 3]
    centre: Tensor,  # [3] of the camera, taken as fixed
) -> RendererInputs:
    """The definition, in the inputs' dtype: oracle and fallback."""
    ranges = torch.linalg.vector_norm(means - centre.detach(), dim=-1, keepdim=True)
    colours = torch.cat([radiance(raw_colours), ranges], dim=-1)
    return RendererInputs(torch.exp(log_scales), torch.sigmoid(opacity_logits[:, 0]), colours)


def activate(
    means: Tensor,  # [N, 3]
    log_scales: Tensor,  # [N, 3]
    opacity_logits: Tensor,  # [N, 1]
    raw_colours: Tensor,  # [N, 3]
    centre: Tensor,  # [3] of the camera, taken as fixed
    threads: int | None = None,
) -> RendererInputs:
    """:func:`activate_torch`, by the kernels where there are any."""
    inputs = (means, log_scales, opacity_logits, raw_colours, centre.detach())
    library = library_or_none() if means.device.type == "cpu" else None
    if library is None or any(tensor.dtype != torch.float32 for tensor in inputs):
        return activate_torch(*inputs)
    threads = threads if threads is not None else torch.get_num_threads()
    plain = [tensor.contiguous() for tensor in inputs]
    return RendererInputs(*_Activate.apply(*plain, threads, library))  # type: ignore[no-untyped-call]


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,  # [N, 3]
        log_scales: Tensor,  # [N, 3]
        opacity_logits: Tensor,  # [N, 1]
        raw_colours: Tensor,  # [N, 3]
        centre: Tensor,  # [3]
        threads: int,
        library: Library,
    ) -> tuple[Tensor, Tensor, Tensor]:
        count = len(means)
        outputs = (torch.empty(count, 3), torch.empty(count), torch.empty(count, 4))
        inputs = (means, log_scales, opacity_logits, raw_colours, centre)
        library.call("aq_activate", *map(pointer, inputs), count, threads, *map(pointer, outputs))
        ctx.save_for_backward(*inputs, outputs[0], outputs[2])
        ctx.threads, ctx.library = threads, library
        return outputs

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        g_scales: Tensor,  # [N, 3]
        g_opacities: Tensor,  # [N]
        g_colours: Tensor,  # [N, 4]
    ) -> tuple[Any, ...]:
        *inputs, scales, colours = ctx.saved_tensors
        incoming = [tensor.contiguous() for tensor in (g_scales, g_opacities, g_colours)]
        gradients = [torch.empty_like(tensor) for tensor in inputs[:4]]
        ctx.library.call(
            "aq_activate_backward",
            *map(pointer, inputs),
            len(scales),
            ctx.threads,
            *map(pointer, (scales, colours, *incoming, *gradients)),
        )
        return (*gradients, None, None, None)
