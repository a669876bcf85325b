"""A scalar whose gradient is computed with it, as fused kernels do."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


class KnownGradient(torch.autograd.Function):
    """Differentiable in its first input, whose gradient ``forward`` saves as its only tensor."""

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        g_scalar: Tensor,  # []
    ) -> tuple[Any, ...]:
        """The saved gradient for the first input, and none for the others."""
        (gradient,) = ctx.saved_tensors
        return (g_scalar * gradient, *[None] * (len(ctx.needs_input_grad) - 1))
