"""The CPU renderers: compiled, a ctypes call inside an autograd function, and torch only."""

from __future__ import annotations

import warnings
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils.checkpoint import checkpoint

from aquaflow.render.contract import (
    CPU,
    Renderer,
    Rendering,
    check_devices,
    check_inputs,
    tile_box,
    tile_grid,
)
from aquaflow.render.library import STAGES, Library, NativeUnavailableError, load_library
from aquaflow.render.limits import TILE_PX
from aquaflow.render.reference import Footprints, alpha_at, blend_weights, project
from aquaflow.render.tensor_address import pointer

Held = TypeVar("Held")
"""What a pool holds."""


class _ContextPool:
    """Native contexts at rest; their buffers are reused by later forward passes."""

    def __init__(self, library: Library) -> None:
        self.library = library
        self.stage_ms = [0.0] * len(STAGES)  # of the native call that ended last
        self.idle: deque[int] = deque()  # append and pop are atomic: renderers may share threads
        weakref.finalize(self, _free_all, library, self.idle)


def _free_all(library: Library, idle: deque[int]) -> None:
    while idle:
        library.free_context(idle.pop())


class Lease(Generic[Held]):
    """Something of a pool, held from a forward pass until its graph is gone."""

    def __init__(self, idle: deque[Held], make: Callable[[], Held]) -> None:
        """Of what is ``idle``, or a new one."""
        self._idle = idle
        try:
            self.held = idle.pop()
        except IndexError:
            self.held = make()

    def __del__(self) -> None:
        if hasattr(self, "held"):
            self._idle.append(self.held)


class _ContextLease(Lease[int]):
    """One native context."""

    def __init__(self, pool: _ContextPool) -> None:
        self._pool = pool
        super().__init__(pool.idle, pool.library.new_context)

    def call(self, kernel: str, *arguments: object) -> None:
        """Run a kernel on the context and keep its stage times, which outlive the lease."""
        self._pool.library.call(kernel, self.held, *arguments)
        self._pool.stage_ms = self._pool.library.stage_ms(self.held)


class CpuRenderer:
    """SIMD kernels from ``native/``, on ``threads`` threads; same result for the same inputs and
    thread count, bit for bit."""

    name = "cpu"
    device = CPU

    def __init__(self, threads: int | None = None, isa: str | None = None) -> None:
        """``threads`` defaults to torch's; ``isa`` to the fastest that this processor runs.

        Raises NativeUnavailableError when no library can be had.
        """
        library = load_library(isa)
        self.isa = library.isa
        self.threads = threads if threads is not None else torch.get_num_threads()
        self._pool = _ContextPool(library)

    def __call__(
        self,
        means: Tensor,  # [N, 3] m, world
        quats: Tensor,  # [N, 4] wxyz, any length
        scales: Tensor,  # [N, 3] m
        opacities: Tensor,  # [N]
        colours: Tensor,  # [N, C]
        viewmat: Tensor,  # [4, 4] world -> camera
        K: Tensor,  # [3, 3] px
        width: int,
        height: int,
        active: Tensor | None = None,  # [ceil(H/16), ceil(W/16)] bool, tiles to draw
    ) -> Rendering:
        """Draw as the contract says; inputs of other types are converted to float32."""
        check_inputs(means, quats, scales, opacities, colours, viewmat, K, width, height, active)
        given = (means, quats, scales, opacities, colours, viewmat)
        check_devices(self.device, *given, K, active)
        inputs = [tensor.to(torch.float32).contiguous() for tensor in given]
        intrinsics = K.detach()[[0, 1, 0, 1], [0, 1, 2, 2]].to(torch.float32)
        drawn_tiles = None if active is None else active.contiguous()
        image, alpha, visible, radius_px = _Rasterise.apply(  # type: ignore[no-untyped-call]
            *inputs, intrinsics, drawn_tiles, self._pool, self.threads, width, height
        )
        return Rendering(image, alpha, visible, radius_px)

    def stage_ms(self) -> dict[str, float]:
        """Wall time of each stage, milliseconds, by the names of ``library.STAGES``.

        Of the pass that ended last: after a backward pass all stages of that picture; after a
        forward pass backward's are zero.
        """
        return dict(zip(STAGES, self._pool.stage_ms, strict=True))


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,  # [N, 3] m, world
        quats: Tensor,  # [N, 4] wxyz
        scales: Tensor,  # [N, 3] m
        opacities: Tensor,  # [N]
        colours: Tensor,  # [N, C]
        viewmat: Tensor,  # [4, 4] world -> camera
        intrinsics: Tensor,  # [4] fx fy cx cy, px
        active: Tensor | None,  # [tiles]
        pool: _ContextPool,
        threads: int,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        n, channels = colours.shape
        image = torch.empty(height, width, channels)
        alpha = torch.empty(height, width)
        visible = torch.empty(n, dtype=torch.bool)
        radius_px = torch.empty(n)
        gaussians = (means, quats, scales, opacities, colours)
        lease = _ContextLease(pool)
        sizes = (n, channels, width, height, threads)
        inputs = map(pointer, (*gaussians, viewmat, intrinsics))
        outputs = (pointer(image), pointer(alpha), pointer(visible, torch.bool), pointer(radius_px))
        mask = None if active is None else pointer(active, torch.bool)
        lease.call("aq_forward", *sizes, *inputs, *outputs, mask)
        ctx.save_for_backward(*gaussians, image)
        ctx.lease = lease
        ctx.mark_non_differentiable(visible, radius_px)
        return image, alpha, visible, radius_px

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        g_image: Tensor,  # [H, W, C]
        g_alpha: Tensor,  # [H, W]
        *_: Tensor,  # [...] of the outputs that have no gradient
    ) -> tuple[Any, ...]:
        *gaussians, image = ctx.saved_tensors
        gradients = [*(torch.empty_like(tensor) for tensor in gaussians), torch.empty(4, 4)]
        incoming = [g_image.contiguous(), g_alpha.contiguous()]
        ctx.lease.call("aq_backward", *map(pointer, (*gaussians, image, *incoming, *gradients)))
        return (*gradients, *[None] * 6)


# --------------------------------------------------------------------------------------------------
# The fallback renderer: torch only, batches of tiles, for machines without a compiler.
#
# Correct and slow: every Gaussian of a tile is evaluated at every pixel of it.

BATCH_ELEMENTS = 4_000_000
"""Gaussian-pixel pairs held at once; backward recomputes each batch instead of keeping them all."""


class TileRenderer:
    """Tiles as a batch dimension, padded to the longest list of the batch."""

    name = "tiles"
    device = CPU
    isa = "torch"

    def __init__(self, threads: int | None = None) -> None:
        """``threads`` is for reports: torch's own setting decides."""
        self.threads = threads if threads is not None else torch.get_num_threads()

    def __call__(
        self,
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
    ) -> Rendering:
        """Draw as the contract says, in the dtype of ``means``."""
        check_inputs(means, quats, scales, opacities, colours, viewmat, K, width, height, active)
        check_devices(self.device, means, quats, scales, opacities, colours, viewmat, K, active)
        dtype = means.dtype
        colours = colours.to(dtype)
        gaussians = (means, quats.to(dtype), scales.to(dtype), opacities.to(dtype), colours)
        camera = (viewmat.to(dtype), K.detach().to(dtype))
        if active is None:
            active = torch.ones(tile_grid(width, height), dtype=torch.bool)
        footprints = project(*gaussians, *camera, width, height, active)
        drawn = _draw(footprints, colours, width, height, active)
        visible, radius_px = footprints.scatter(len(means))
        return Rendering(drawn[..., :-1], drawn[..., -1], visible, radius_px)


@dataclass(frozen=True)
class _TileLists:
    """For every active tile, row by row, its footprints front to back."""

    tile: Tensor  # [T] long, row by row
    start: list[int]  # [T + 1]
    footprint: Tensor  # [L] long


def _tile_lists(
    footprints: Footprints,
    active: Tensor,  # [rows, columns] bool
    width: int,
    height: int,
) -> _TileLists:
    """Pairs of footprints and active tiles that their boxes touch."""
    with torch.no_grad():
        centre, extent = footprints.centre, footprints.extent
        low, high = tile_box(centre - extent, centre + extent, width, height)
        size = high - low + 1
        count = size[:, 0] * size[:, 1]
        footprint = torch.arange(len(count), device=count.device).repeat_interleave(count)
        within = torch.arange(len(footprint), device=count.device)
        within = within - (count.cumsum(0) - count)[footprint]
        x = low[footprint, 0] + within % size[footprint, 0]
        y = low[footprint, 1] + within // size[footprint, 0]
        drawn = active[y, x]
        tile = (y * active.shape[1] + x)[drawn]
        tile, by_tile = torch.sort(tile, stable=True)  # stable: the lists stay in depth order
        listed = torch.nonzero(active.reshape(-1))[:, 0]
        per_tile = torch.bincount(tile, minlength=active.numel())[listed]
        start = [0, *per_tile.cumsum(0).tolist()]
    return _TileLists(listed, start, footprint[drawn][by_tile])


def _batches(lists: _TileLists) -> list[tuple[int, int, int]]:
    """Runs of tiles [first, last) with their longest list, each within BATCH_ELEMENTS."""
    runs: list[tuple[int, int, int]] = []
    first, longest = 0, 0
    for tile in range(len(lists.tile)):
        length = lists.start[tile + 1] - lists.start[tile]
        elements = (tile + 1 - first) * max(longest, length) * TILE_PX * TILE_PX
        if tile > first and elements > BATCH_ELEMENTS:
            runs.append((first, tile, longest))
            first, longest = tile, 0
        longest = max(longest, length)
    return [*runs, (first, len(lists.tile), longest)]


def _draw(
    footprints: Footprints,
    colours: Tensor,  # [N, C]
    width: int,
    height: int,
    active: Tensor,  # [rows, columns] bool
) -> Tensor:
    """[H, W, C + 1]: premultiplied colours, then alpha."""
    lists = _tile_lists(footprints, active, width, height)
    tiles_y, tiles_x = active.shape
    opaque = torch.ones_like(colours[:, :1])
    layers = torch.cat([colours, opaque], 1)[footprints.index]
    drawn: list[Tensor] = []
    for first, last, longest in _batches(lists):
        slots, filled = _pad(lists, first, last, longest, layers.device)
        corner = _tile_corners(lists.tile[first:last], tiles_x, layers)
        arguments = (footprints.centre, footprints.conic, footprints.opacity, layers)
        drawn.append(
            checkpoint(_draw_batch, *arguments, slots, filled, corner, use_reentrant=False)
        )
    black = layers.new_zeros(active.numel(), TILE_PX * TILE_PX, layers.shape[1])
    grid = black.index_copy(0, lists.tile, torch.cat(drawn))
    grid = grid.view(tiles_y, tiles_x, TILE_PX, TILE_PX, -1)
    image = grid.transpose(1, 2).reshape(tiles_y * TILE_PX, tiles_x * TILE_PX, -1)
    return image[:height, :width]


def _pad(
    lists: _TileLists, first: int, last: int, longest: int, device: torch.device
) -> tuple[Tensor, Tensor]:
    """[T, longest] footprint per slot, and whether the slot is filled."""
    start = torch.tensor(lists.start[first:last], dtype=torch.long, device=device)[:, None]
    end = torch.tensor(lists.start[first + 1 : last + 1], dtype=torch.long, device=device)[:, None]
    at = start + torch.arange(longest, device=device)
    filled = at < end
    return lists.footprint[torch.where(filled, at, 0)] if longest else at, filled


def _tile_corners(
    tile: Tensor,  # [T] long
    tiles_x: int,
    like: Tensor,  # [...] of the dtype that is wanted
) -> Tensor:
    """[T, 2] px."""
    return TILE_PX * torch.stack([tile % tiles_x, tile // tiles_x], 1).to(like.dtype)


def _draw_batch(
    centre: Tensor,  # [M, 2] px
    conic: Tensor,  # [M, 3]
    opacity: Tensor,  # [M]
    layers: Tensor,  # [M, C + 1]
    slots: Tensor,  # [T, L]
    filled: Tensor,  # [T, L]
    corner: Tensor,  # [T, 2] px
) -> Tensor:
    """[T, TILE_PX^2, C + 1]."""
    step = torch.arange(TILE_PX, dtype=centre.dtype, device=centre.device) + 0.5
    pixels = torch.stack(torch.meshgrid(step, step, indexing="xy"), 2).view(-1, 2)
    offset = (corner[:, None] + pixels)[:, None] - centre[slots][:, :, None]
    faint = torch.zeros((), dtype=opacity.dtype, device=opacity.device)
    alpha = alpha_at(offset, conic[slots], torch.where(filled, opacity[slots], faint))
    return torch.einsum("tlp,tlc->tpc", blend_weights(alpha, 1), layers[slots])


def cpu_renderer(threads: int | None = None, may_fall_back: bool = True) -> Renderer:
    """The CPU's renderer: compiled kernels, else, if it ``may_fall_back``, torch's tiles."""
    try:
        return CpuRenderer(threads)
    except NativeUnavailableError as error:
        if not may_fall_back:
            raise
        warnings.warn(
            f"{error} Drawing with the torch tile renderer instead, hundreds of times slower.",
            RuntimeWarning,
            stacklevel=3,
        )
        return TileRenderer(threads)
