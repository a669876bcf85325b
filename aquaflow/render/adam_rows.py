"""One step of Adam on chosen rows of tensors, each row at its own count of steps, in torch.

The rows are a mask and never become indices, whose number a GPU would have to be asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

Kernel = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, float, float, float, float], None]
"""``adam(param, param_grad, exp_avg, exp_avg_sq, valid, lr, b1, b2, eps)`` of gsplat: changes the
first, third and fourth in the rows that are ``valid``, without bias correction."""


@dataclass(frozen=True)
class Moved:
    """A tensor that takes a step; all but the gradient are changed in place."""

    parameter: Tensor
    """[N, ...]"""
    gradient: Tensor
    """[N, ...]"""
    first_moment: Tensor
    """[N, ...]"""
    second_moment: Tensor
    """[N, ...]"""
    learning_rate: float


def step_rows(
    moved: Moved,
    rows: Tensor,  # [N] bool, those to step
    bias: Tensor,  # [N, 2] 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t) of each row
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Kingma & Ba 2015, Algorithm 1; other rows stay as they are."""
    (beta1, beta2), first, second = betas, moved.first_moment, moved.second_moment
    shape = (-1, *[1] * (first.dim() - 1))
    chosen, (b1, b2) = rows.view(shape), (each.view(shape) for each in bias.unbind(1))
    g = torch.where(chosen, moved.gradient, 0.0)
    m = beta1 * first + (1 - beta1) * g
    v = beta2 * second + (1 - beta2) * g * g
    change = moved.learning_rate * b1 * m / (v.sqrt() * b2 + eps)
    first.copy_(torch.where(chosen, m, first))
    second.copy_(torch.where(chosen, v, second))
    moved.parameter.sub_(torch.where(chosen, change, 0.0))


def step_rows_fused(
    kernel: Kernel,
    moved: Moved,
    rows: Tensor,  # [N] bool
    bias: Tensor,  # [N, 2]
    betas: tuple[float, float],
    eps: float,
) -> None:
    """The same by gsplat's kernel, whose step from zero is then corrected for its bias.

    ``eps`` is added before the correction, not after it; at 1e-15 no gradient is small enough for
    that to show.
    """
    if moved.parameter.numel() == 0:
        return  # the kernel divides by the number of rows
    change, gradient = torch.zeros_like(moved.parameter), moved.gradient.contiguous()
    kernel(
        change, gradient, moved.first_moment, moved.second_moment, rows, moved.learning_rate,
        *betas, eps,
    )  # fmt: skip
    corrected = (bias[:, 0] / bias[:, 1]).view(-1, *[1] * (change.dim() - 1))
    moved.parameter.addcmul_(change, corrected)


@lru_cache
def fused_kernel(device_type: str) -> Kernel | None:
    """gsplat's, where the device is CUDA's and gsplat has kernels for it; else None."""
    from aquaflow.render import gsplat

    if device_type != "cuda" or not gsplat.available():
        return None
    from gsplat.cuda._wrapper import adam

    kernel: Kernel = adam
    return kernel
