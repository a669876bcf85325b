"""The decoder's part that knows the view, fused with its gradient (paper, Sec. 3.3.1).

The view-independent part of the decoder comes in as a row of ``trunk`` for each Gaussian;
out come the attributes as they are seen from one camera. Readable definition, and fallback:
``Decoder.residuals`` and ``apply_residuals`` of :mod:`aquaflow.mapping.neural.decoder`.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from aquaflow.render.library import Library
from aquaflow.render.tensor_address import pointer

MAX_WIDTH = 64
"""Widest decoder that the kernel takes; its width is a multiple of UNITS."""
UNITS = 4
"""Hidden units that the kernel sums at once: kUnits of native/decode_view.h."""


@dataclass(frozen=True)
class ViewWeights:
    """The decoder's weights that are applied for every view; h is [V, d]."""

    view: Tensor
    """[d, E] of gamma(o); E is 36, or 27 without distance."""
    heads: Tensor
    """[9, d / 2]: six rows of geometry on the first half of h, three of colour on the second."""
    bias: Tensor
    """[9]"""
    limits: Tensor
    """[9] largest residuals."""


class _NativeView(ctypes.Structure):
    """``DecoderView`` of native/decode_view.h."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("count", "width", "code")),
        *(
            (name, ctypes.c_void_p)
            for name in (
                "rows", "places", "means", "centre", "trunk", "view", "heads", "bias", "limits",
                "quats",
            )
        ),
    )  # fmt: skip


class _NativeGradients(ctypes.Structure):
    """``DecoderGradients`` of native/decode_view_backward.h."""

    _fields_ = tuple(
        (name, ctypes.c_void_p)
        for name in ("log_scales", "raw_colours", "quats", "trunk", "view", "heads", "bias")
    )


def takes(width: int) -> bool:
    """Whether the kernel is made for decoders of this width."""
    return width <= MAX_WIDTH and width % UNITS == 0


def decode_view(
    attributes: tuple[Tensor, Tensor, Tensor],  # quats [N, 4], log_scales [N, 3], raw_colours
    trunk: Tensor,  # [P, d]
    weights: ViewWeights,
    rows: Tensor,  # [V] int64 Gaussian, each once
    places: Tensor,  # [V] int64 its row of ``trunk``, each once
    means: Tensor,  # [N, 3] map units
    centre: Tensor,  # [3] of the camera
    threads: int,
    library: Library,
) -> tuple[Tensor, Tensor, Tensor]:
    """The attributes with the residuals of ``rows`` on top; other rows are as they were.

    Differentiable in the initial attributes, the trunk and the weights, not in the places.
    """
    fixed = (rows, places, means.detach().contiguous(), centre.detach().contiguous())
    decoded: tuple[Tensor, Tensor, Tensor] = _DecodeView.apply(  # type: ignore[no-untyped-call]
        *attributes,
        trunk.contiguous(),
        weights.view.contiguous(),
        weights.heads.contiguous(),
        weights.bias.contiguous(),
        weights.limits,
        fixed,
        threads,
        library,
    )
    return decoded


class _DecodeView(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        quats: Tensor,  # [N, 4] wxyz
        log_scales: Tensor,  # [N, 3]
        raw_colours: Tensor,  # [N, 3]
        trunk: Tensor,  # [P, d]
        view: Tensor,  # [d, E]
        heads: Tensor,  # [9, d / 2]
        bias: Tensor,  # [9]
        limits: Tensor,  # [9]
        fixed: tuple[Tensor, Tensor, Tensor, Tensor],  # [V], [V], [N, 3], [3]: see _inputs
        threads: int,
        library: Library,
    ) -> tuple[Tensor, Tensor, Tensor]:
        decoded = (quats.clone(), log_scales.clone(), raw_colours.clone())
        inputs = _inputs(trunk, view, heads, bias, limits, quats, fixed)
        library.call("aq_decode_view", ctypes.addressof(inputs), threads, *(map(pointer, decoded)))
        ctx.save_for_backward(trunk, view, heads, bias, limits, quats)
        ctx.fixed, ctx.threads, ctx.library = fixed, threads, library
        return decoded

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        g_quats: Tensor,  # [N, 4]
        g_log_scales: Tensor,  # [N, 3]
        g_raw_colours: Tensor,  # [N, 3]
    ) -> tuple[Any, ...]:
        trunk, view, heads, bias, limits, quats = ctx.saved_tensors
        g_base, g_log_scales, g_raw_colours = (
            g_quats.clone(), g_log_scales.contiguous(), g_raw_colours.contiguous(),
        )  # fmt: skip
        g_trunk = torch.zeros_like(trunk)
        g_weights = [torch.empty_like(tensor) for tensor in (view, heads, bias)]
        gradients = (g_log_scales, g_raw_colours, g_base, g_trunk, *g_weights)
        inputs = _inputs(trunk, view, heads, bias, limits, quats, ctx.fixed)
        outputs = _NativeGradients(*map(pointer, gradients))
        ctx.library.call(
            "aq_decode_view_backward",
            ctypes.addressof(inputs),
            ctx.threads,
            ctypes.addressof(outputs),
        )
        return (g_base, g_log_scales, g_raw_colours, g_trunk, *g_weights, *[None] * 4)


def _inputs(
    trunk: Tensor,  # [P, d]
    view: Tensor,  # [d, E]
    heads: Tensor,  # [9, d / 2]
    bias: Tensor,  # [9]
    limits: Tensor,  # [9]
    quats: Tensor,  # [N, 4] wxyz
    fixed: tuple[Tensor, Tensor, Tensor, Tensor],  # rows [V], places [V], means [N, 3], centre [3]
) -> _NativeView:
    rows, places, means, centre = fixed
    numbers = (pointer(each, torch.int64) for each in (rows, places))
    tensors = map(pointer, (means, centre, trunk, view, heads, bias, limits, quats))
    return _NativeView(len(rows), *view.shape, *numbers, *tensors)
