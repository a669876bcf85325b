"""The photometric loss of the map: weighted L1 and SSIM under a mask, fused with its gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.contract import CPU
from aquaflow.render.library import Library, library_or_none
from aquaflow.render.tensor_address import pointer

# --------------------------------------------------------------------------------------------------
# A scalar whose gradient is computed with it, as fused kernels do.


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


# --------------------------------------------------------------------------------------------------
# The loss of a picture against another.

SSIM_WINDOW = 11
SSIM_SIGMA_PX = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
"""Window, sigma and constants as Wang et al. 2004 have them, for values in [0, 1]."""


def ssim(
    x: Tensor,  # [H, W, 3] in [0, 1]
    y: Tensor,  # [H, W, 3] in [0, 1]
) -> Tensor:
    """Mean structural similarity (Wang et al. 2004): 11 x 11 Gaussian window, zero padding."""
    t = torch.arange(SSIM_WINDOW, dtype=x.dtype, device=x.device) - SSIM_WINDOW // 2
    g = torch.exp(-t * t / (2 * SSIM_SIGMA_PX**2))
    g = g / g.sum()

    def window_mean(
        image: Tensor,  # [C, 1, H, W]
    ) -> Tensor:
        rows = F.conv2d(image, g.view(1, 1, 1, -1), padding=(0, SSIM_WINDOW // 2))
        return F.conv2d(rows, g.view(1, 1, -1, 1), padding=(SSIM_WINDOW // 2, 0))

    a, b = x.permute(2, 0, 1)[:, None], y.permute(2, 0, 1)[:, None]
    mu_x, mu_y = window_mean(a), window_mean(b)
    var_x, var_y = window_mean(a * a) - mu_x * mu_x, window_mean(b * b) - mu_y * mu_y
    cov = window_mean(a * b) - mu_x * mu_y
    luminance = (2 * mu_x * mu_y + SSIM_C1) / (mu_x * mu_x + mu_y * mu_y + SSIM_C1)
    return (luminance * (2 * cov + SSIM_C2) / (var_x + var_y + SSIM_C2)).mean()


def photometric_loss_torch(
    rendered: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    weight: Tensor,  # [H, W]
    mask: Tensor | None,  # [H, W]
    ssim_weight: float,
) -> Tensor:
    """The definition of the loss, in the inputs' dtype: oracle and fallback."""
    if mask is not None:
        shade = mask.to(rendered.dtype)[..., None]
        rendered, target = shade * rendered, shade * target
    l1 = (weight[..., None] * (rendered - target).abs()).mean()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim(rendered, target))


def photometric_loss(
    rendered: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    weight: Tensor,  # [H, W] of the L1 term
    mask: Tensor | None,  # [H, W] bool or float; None: all ones
    ssim_weight: float,
    threads: int | None = None,
) -> Tensor:
    """(1 - l) mean(weight |M (rendered - target)|) + l (1 - SSIM(M rendered, M target)).

    l is ``ssim_weight``, M the mask, the means run over all pixels and channels.
    Scalar, differentiable in ``rendered`` only. Off the CPU, and where no compiled library is to be
    had, torch computes it. Raises AquaFlowError for shapes that do not fit.
    """
    _check(rendered, target, weight, mask)
    library = library_or_none() if rendered.device.type == "cpu" else None
    if library is None:
        target, weight = target.detach(), weight.detach()
        return photometric_loss_torch(rendered, target, weight, mask, ssim_weight)
    constants = [_plain(tensor) for tensor in (target, weight)]
    shade = None if mask is None else _plain(mask)
    threads = threads if threads is not None else torch.get_num_threads()
    plain = rendered.to(torch.float32).contiguous()
    loss: Tensor = _Photometric.apply(  # type: ignore[no-untyped-call]
        plain, *constants, shade, ssim_weight, threads, library
    )
    return loss


def _plain(
    tensor: Tensor,  # [...]
) -> Tensor:
    return tensor.detach().to(torch.float32).contiguous()


def _check(
    rendered: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    weight: Tensor,  # [H, W]
    mask: Tensor | None,  # [H, W]
) -> None:
    if rendered.dim() != 3 or rendered.shape[2] != 3:
        raise AquaFlowError(
            f"Loss input rendered has shape {tuple(rendered.shape)}; pass an [H, W, 3] image."
        )
    shape = tuple(rendered.shape)
    expected = {"target": (target, shape), "weight": (weight, shape[:2])}
    if mask is not None:
        expected["mask"] = (mask, shape[:2])
    for name, (tensor, wanted) in expected.items():
        if tuple(tensor.shape) != wanted:
            raise AquaFlowError(
                f"Loss input {name} has shape {tuple(tensor.shape)}; pass {wanted} to fit rendered."
            )


class _Photometric(KnownGradient):
    @staticmethod
    def forward(
        ctx: Any,
        rendered: Tensor,  # [H, W, 3]
        target: Tensor,  # [H, W, 3]
        weight: Tensor,  # [H, W]
        mask: Tensor | None,  # [H, W]
        ssim_weight: float,
        threads: int,
        library: Library,
    ) -> Tensor:
        height, width, _ = rendered.shape
        loss = torch.empty(1)
        gradient = torch.empty_like(rendered) if ctx.needs_input_grad[0] else None
        images = (rendered, target, weight, mask)
        library.call(
            "aq_photometric",
            *(None if image is None else pointer(image) for image in images),
            width,
            height,
            ssim_weight,
            threads,
            pointer(loss),
            None if gradient is None else pointer(gradient),
        )
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return loss[0]


# --------------------------------------------------------------------------------------------------
# What the loss of a view has beside the pictures' likeness: outliers, and the prior's ranges.
#
# Each has its definition in torch, which is the oracle of the kernel and what other devices use.

RADIAL_VARIANCE = 5.0
"""sigma^2 of K_rad in units of the half picture: corner weight 0.82 (ARTDECO; docs/paper.md)."""


def radial_weight(height: int, width: int, device: torch.device = CPU) -> Tensor:
    """K_rad [H, W] = exp(-r^2 / (2 sigma^2)), r in [-1, 1]^2 picture coordinates."""
    y = torch.linspace(-1.0, 1.0, height, device=device)[:, None]
    x = torch.linspace(-1.0, 1.0, width, device=device)[None, :]
    return torch.exp(-(x * x + y * y) / (2.0 * RADIAL_VARIANCE)).contiguous()


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
    _check_shapes([weight, rendered[..., 0], target[..., 0]])
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
    _check_shapes([z, alpha, inverse_range, weight])
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


def _check_shapes(
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


def _threads(threads: int | None) -> int:
    return threads if threads is not None else torch.get_num_threads()
