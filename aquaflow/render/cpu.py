"""The compiled CPU renderer: a ctypes call inside an autograd function."""

from __future__ import annotations

import weakref
from collections import deque
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from aquaflow.render.contract import CPU, Rendering, check_devices, check_inputs
from aquaflow.render.library import STAGES, Library, load_library
from aquaflow.render.tensor_address import pointer


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


class _Lease:
    """One context, held from a forward pass until its graph is gone."""

    def __init__(self, pool: _ContextPool) -> None:
        self.pool = pool
        try:
            self.context = pool.idle.pop()
        except IndexError:
            self.context = pool.library.new_context()

    def __del__(self) -> None:
        if hasattr(self, "context"):
            self.pool.idle.append(self.context)

    def call(self, kernel: str, *arguments: object) -> None:
        """Run a kernel on the context and keep its stage times, which outlive the lease."""
        self.pool.library.call(kernel, self.context, *arguments)
        self.pool.stage_ms = self.pool.library.stage_ms(self.context)


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
        lease = _Lease(pool)
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
