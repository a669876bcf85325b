"""What every renderer takes, returns and means by it.

World points map to the camera by the 4x4 ``viewmat`` (axes x right, y down, z forward, metres); the
centre of the top-left pixel is (0.5, 0.5). Images are premultiplied: the accumulated sum of weight
times colour over a black background, so callers composite with ``alpha``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.library import Library, library_or_none
from aquaflow.render.limits import TILE_PX
from aquaflow.render.tensor_address import pointer

CPU = torch.device("cpu")
"""Where everything is unless a renderer draws elsewhere."""


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Rows and columns of tiles; the last ones may reach beyond the picture."""
    return -(-height // TILE_PX), -(-width // TILE_PX)


@dataclass(frozen=True)
class Rendering:
    """One picture and what it says about the Gaussians."""

    image: Tensor
    """[H, W, C] premultiplied, differentiable."""

    alpha: Tensor
    """[H, W] in [0, 1], differentiable."""

    visible: Tensor
    """[N] bool: sound, in front of the camera, and reaching 1/255 of alpha on the image.

    With an activity mask also: the box around its 1/255 ellipse touches an active tile. What
    touches none does not affect the picture, so an optimiser must not move it by old moments.
    """

    radius_px: Tensor
    """[N] three standard deviations of the footprint, pixels; 0 where not visible."""


class Renderer(Protocol):
    """A differentiable Gaussian rasteriser."""

    name: str
    isa: str
    """For reports: ``avx512``, ``avx2``, ``sse4``, ``neon``, ``torch`` or ``cuda``."""

    threads: int

    device: torch.device
    """Where inputs have to be and results are; the map that is drawn lives there."""

    def __call__(
        self,
        means: Tensor,  # [N, 3] m, world
        quats: Tensor,  # [N, 4] wxyz, any length
        scales: Tensor,  # [N, 3] m, standard deviations
        opacities: Tensor,  # [N]
        colours: Tensor,  # [N, C], C is 3 or 4
        viewmat: Tensor,  # [4, 4] world -> camera
        K: Tensor,  # [3, 3] px; skew is ignored
        width: int,
        height: int,
        active: Tensor | None = None,  # [ceil(H/16), ceil(W/16)] bool, tiles to draw
    ) -> Rendering:
        """Draw. Differentiable in all tensors but ``K``.

        Tiles of TILE_PX pixels that are not ``active`` stay black and transparent and take no
        gradient, at next to no cost on the CPU; the others are as they were without the mask.
        None draws all.

        A Gaussian that is not finite, has a zero quaternion, a scale or opacity that is not
        positive, or lies behind the near plane is culled: it draws nothing and its gradient is
        zero. A camera that is not finite culls all. Raises AquaFlowError for wrong shapes and for
        tensors on another device: a renderer moves nothing.
        """
        ...


def check_inputs(
    means: Tensor,  # [N, 3] m, world
    quats: Tensor,  # [N, 4] wxyz
    scales: Tensor,  # [N, 3] m
    opacities: Tensor,  # [N]
    colours: Tensor,  # [N, C]
    viewmat: Tensor,  # [4, 4] world -> camera
    K: Tensor,  # [3, 3] px
    width: int,
    height: int,
    active: Tensor | None = None,  # [ceil(H/16), ceil(W/16)] bool, tiles to draw
) -> None:
    """Raise AquaFlowError naming the first input whose shape or type breaks the contract."""
    n = len(means) if means.dim() else 0
    expected = {
        "means": (means, (n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "opacities": (opacities, (n,)),
        "viewmat": (viewmat, (4, 4)),
        "K": (K, (3, 3)),
    }
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise AquaFlowError(
                f"Renderer input {name} has shape {tuple(tensor.shape)}; pass {shape}."
            )
    if colours.dim() != 2 or colours.shape[0] != n or colours.shape[1] not in {3, 4}:
        raise AquaFlowError(
            f"Renderer input colours has shape {tuple(colours.shape)}; pass ({n}, 3) or ({n}, 4)."
        )
    if width < 1 or height < 1:
        raise AquaFlowError(f"Image size {width} x {height} is empty; pass at least 1 x 1 pixels.")
    grid = tile_grid(width, height)
    if active is not None and (tuple(active.shape) != grid or active.dtype != torch.bool):
        raise AquaFlowError(
            f"Renderer input active is {active.dtype} {tuple(active.shape)}; "
            f"pass torch.bool {grid}, one element per tile of {TILE_PX} pixels."
        )


def check_devices(
    device: torch.device,
    *tensors: Tensor | None,  # [...] inputs of a renderer
) -> None:
    """Raise AquaFlowError where one of ``tensors`` is not on ``device``."""
    for tensor in tensors:
        if tensor is not None and tensor.device.type != device.type:
            raise AquaFlowError(
                f"The renderer draws on {device} and was given a tensor on {tensor.device}; "
                "move the map to the renderer's device first."
            )


# --------------------------------------------------------------------------------------------------
# The activity mask: which tiles of a picture are drawn, over pixels and over footprints.


def active_pixels(
    active: Tensor,  # [ceil(H/16), ceil(W/16)] bool
    width: int,
    height: int,
) -> Tensor:
    """[H, W] bool: whether the tile of a pixel is active."""
    rows = active.repeat_interleave(TILE_PX, 0)[:height]
    return rows.repeat_interleave(TILE_PX, 1)[:, :width]


def tile_box(
    low: Tensor,  # [M, 2] px
    high: Tensor,  # [M, 2] px
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """First and last tile (column, row) [M, 2] whose pixel centres each box reaches.

    Clamped to the picture. As in the kernels, a box in the gap between the centres of two tiles
    counts for the first.
    """
    rows, columns = tile_grid(width, height)
    first, final = (
        torch.stack([_tile_of(x, columns), _tile_of(y, rows)], dim=1)
        for x, y in (low.unbind(1), high.unbind(1))
    )
    return first, final


def _tile_of(
    edge: Tensor,  # [M] px
    tiles: int,
) -> Tensor:
    """[M] the tile that an edge reaches, of those along one axis."""
    return ((edge - 0.5) / TILE_PX).nan_to_num().floor().clamp(0, tiles - 1).long()


def touches_active(
    low: Tensor,  # [M, 2] px
    high: Tensor,  # [M, 2] px
    active: Tensor,  # [ceil(H/16), ceil(W/16)] bool
    width: int,
    height: int,
) -> Tensor:
    """[M] bool: whether a box touches an active tile; four reads of a summed-area table each."""
    first, final = tile_box(low, high, width, height)
    size = (active.shape[0] + 1, active.shape[1] + 1)
    table = torch.zeros(size, dtype=torch.long, device=active.device)
    table[1:, 1:] = active.long().cumsum(0).cumsum(1)
    (x0, y0), (x1, y1) = first.unbind(1), (final + 1).unbind(1)
    return table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] > 0


# --------------------------------------------------------------------------------------------------
# What is drawn of the Gaussians' raw parameters, fused with its gradient.
#
# Scales are exponentials and opacities logistic functions; the radiance J is a softplus, positive
# and with a gradient everywhere. The range from the camera is drawn as a fourth colour.

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
