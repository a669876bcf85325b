"""What the loss of a view has beside the pictures' likeness: outliers, and the prior's ranges.

Each has its definition in torch, which is the oracle of the kernel and what other devices use.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.known_gradient import KnownGradient
from aquaflow.render.library import Library, library_or_none
from aquaflow.render.tensor_address import pointer

MIN_RANGE = 1e-2
"""Map units; guards 1 / range."""
SOLID = 0.5
"""Alpha above which the map's range means something."""


def outlier_mask_torch(
    rendered: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    weight: Tensor,  # [H, W]
    tau_e: float,
) -> Tensor:
    """The definition of :func:`outlier_mask`."""
    worst = (rendered.detach() - target).abs().amax(dim=-1)
    return weight * worst <= tau_e


def outlier_mask(
    rendered: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    weight: Tensor,  # [H, W] K_rad
    tau_e: float,
    threads: int | None = None,
) -> Tensor:
    """M [H, W] bool: False where any channel's weighted residual exceeds ``tau_e``.

    Raises AquaFlowError for shapes that do not fit.
    """
    library = _library(rendered)
    if library is None:
        return outlier_mask_torch(rendered, target, weight, tau_e)
    images = [_plain(image) for image in (rendered, target, weight)]
    _check([weight, rendered[..., 0], target[..., 0]])
    mask = torch.empty(weight.shape, dtype=torch.bool)
    inputs = (*map(pointer, images), tau_e, mask.numel(), _threads(threads))
    library.call("aq_outlier_mask", *inputs, pointer(mask, torch.bool))
    return mask


def depth_loss_torch(
    z: Tensor,  # [H, W]
    alpha: Tensor,  # [H, W]
    inverse_range: Tensor,  # [H, W]
    weight: Tensor,  # [H, W]
) -> Tensor:
    """The definition of :func:`depth_loss`."""
    known = weight * (inverse_range > 0.0) * (alpha.detach() > SOLID)
    return (known * (1.0 / z.clamp_min(MIN_RANGE) - inverse_range).abs()).mean()


def depth_loss(
    z: Tensor,  # [H, W] rendered range
    alpha: Tensor,  # [H, W]
    inverse_range: Tensor,  # [H, W] 1 / range of the prior; 0 where unknown
    weight: Tensor,  # [H, W] K_rad x mask x the prior's confidence
    threads: int | None = None,
) -> Tensor:
    """L_depth (Eq. 21): weighted L1 between inverse ranges, where the prior knows and the map is
    solid. Scalar, differentiable in ``z`` only. Raises AquaFlowError for shapes that do not fit.
    """
    library = _library(z)
    if library is None:
        return depth_loss_torch(z, alpha, inverse_range.detach(), weight.detach())
    _check([z, alpha, inverse_range, weight])
    constants = [_plain(values) for values in (alpha, inverse_range, weight)]
    plain = z.to(torch.float32).contiguous()
    loss: Tensor = _Ranges.apply(  # type: ignore[no-untyped-call]
        plain, *constants, _threads(threads), library
    )
    return loss


class _Ranges(KnownGradient):
    @staticmethod
    def forward(
        ctx: Any,
        z: Tensor,  # [H, W]
        alpha: Tensor,  # [H, W]
        inverse_range: Tensor,  # [H, W]
        weight: Tensor,  # [H, W]
        threads: int,
        library: Library,
    ) -> Tensor:
        loss, gradient = torch.empty(1), torch.empty_like(z)
        inputs = map(pointer, (z, alpha, inverse_range, weight))
        outputs = (pointer(loss), pointer(gradient))
        library.call("aq_range_loss", *inputs, MIN_RANGE, z.numel(), threads, *outputs)
        ctx.save_for_backward(gradient)
        return loss[0]


def _check(
    planes: Sequence[Tensor],  # each [H, W]
) -> None:
    shapes = {tuple(plane.shape) for plane in planes}
    if len(shapes) > 1:
        raise AquaFlowError(
            f"The loss of a view got planes of shapes {sorted(shapes)}; pass one [H, W] for all."
        )


def _library(
    tensor: Tensor,  # [...]
) -> Library | None:
    return library_or_none() if tensor.device.type == "cpu" else None


def _plain(
    tensor: Tensor,  # [...]
) -> Tensor:
    return tensor.detach().to(torch.float32).contiguous()


def _threads(threads: int | None) -> int:
    return threads if threads is not None else torch.get_num_threads()
