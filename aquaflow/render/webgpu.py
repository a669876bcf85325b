"""The renderer ``wgpu``: WGSL kernels behind the contract, inputs and results on the host.

A drawing uploads its Gaussians and downloads its picture; a gradient uploads that of the picture
and downloads that of the Gaussians.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from aquaflow.base.errors import AquaFlowError, first_line
from aquaflow.render.contract import (
    CPU,
    Renderer,
    Rendering,
    check_devices,
    check_inputs,
    tile_grid,
)
from aquaflow.render.cpu import Lease, cpu_renderer
from aquaflow.render.limits import TANGENT_MARGIN
from aquaflow.render.webgpu_device import missing, shared_device
from aquaflow.render.webgpu_drawing import COLOURS, MEAN, OPACITY, QUAT, ROW, SCALES, Drawing

log = logging.getLogger(__name__)


class WgpuRenderer:
    """Draws on the GPU that the machine has, whoever made it, a map that lives on the host.

    The same result for the same inputs, bit for bit: no kernel adds in an order that may change.
    Where the GPU fails, this and all later drawings are the processor's; it is said once, and
    ``name`` and ``isa`` are the other renderer's then.
    """

    name = "wgpu"
    device = CPU

    def __init__(self, threads: int | None = None) -> None:
        """``threads``: of what the processor does meanwhile, torch's number by default.

        Raises AquaFlowError, saying what to do, when something is missing.
        """
        reason = missing()
        if reason is not None:
            raise AquaFlowError(reason)
        self._device = shared_device()
        self.isa = str(self._device.adapter)
        self.threads = threads if threads is not None else torch.get_num_threads()
        self._idle: deque[Drawing] = deque()  # append and pop are atomic
        self._instead: Renderer | None = None
        self.failed: str | None = None
        """What failed, once it did."""

    @property
    def is_software(self) -> bool:
        """Whether the adapter is a program that stands in for a GPU."""
        return self._device.adapter.is_software

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
        gaussians = (means, quats, scales, opacities, colours)
        check_devices(self.device, *gaussians, viewmat, K, active)
        inputs = [tensor.to(torch.float32) for tensor in (*gaussians, viewmat)]
        camera = _Camera(K.detach().to(torch.float32), width, height, active)
        if self._instead is None:
            try:
                image, alpha, radius_px = _Rasterise.apply(*inputs, camera, self)  # type: ignore[no-untyped-call]
                return Rendering(image, alpha, radius_px > 0, radius_px)
            except Exception as error:  # of drivers, which say what they like
                self.leave_gpu(error)
        return self._on_processor(inputs, camera)

    def leave_gpu(self, error: Exception) -> None:
        """From here on the processor draws."""
        if self._instead is None:
            self.failed = f"{self._device.adapter.name} failed ({first_line(error)})"
            log.warning("%s; the processor draws from here on, more slowly", self.failed)
            self._instead = cpu_renderer(self.threads)
            self.name, self.isa = self._instead.name, self._instead.isa
            self._idle.clear()

    def _on_processor(
        self,
        inputs: Sequence[Tensor],  # means [N, 3] to viewmat [4, 4]
        camera: _Camera,
    ) -> Rendering:
        assert self._instead is not None
        means, quats, scales, opacities, colours, viewmat = inputs
        rest = (camera.K, camera.width, camera.height, camera.active)
        return self._instead(means, quats, scales, opacities, colours, viewmat, *rest)

    def gradients_on_processor(
        self,
        inputs: Sequence[Tensor],  # means [N, 3] to viewmat [4, 4]
        camera: _Camera,
        g_image: Tensor,  # [H, W, C]
        g_alpha: Tensor,  # [H, W]
    ) -> tuple[Tensor, ...]:
        """Gradients of the inputs, for a picture that the GPU drew before it failed."""
        with torch.enable_grad():
            leaves = [tensor.detach().requires_grad_() for tensor in inputs]
            drawn = self._on_processor(leaves, camera)
            return torch.autograd.grad([drawn.image, drawn.alpha], leaves, [g_image, g_alpha])

    def lease(self) -> Lease[Drawing]:
        """Buffers that no other drawing uses."""
        return Lease(self._idle, partial(Drawing, self._device))


@dataclass(frozen=True)
class _Camera:
    """What of a drawing has no gradient."""

    K: Tensor  # [3, 3] px
    width: int
    height: int
    active: Tensor | None  # [rows, columns] bool


def drawn_tiles(
    active: Tensor | None,  # [rows, columns] bool
    width: int,
    height: int,
) -> npt.NDArray[np.uint32]:
    """[rows, columns], as the kernels have them; None: all are drawn."""
    if active is None:
        return np.ones(tile_grid(width, height), np.uint32)
    return active.numpy().astype(np.uint32)


def camera_bits(
    viewmat: Tensor,  # [4, 4] world -> camera
    K: Tensor,  # [3, 3] px
    width: int,
    height: int,
    count: int,
) -> npt.NDArray[np.uint32]:
    """[28] the struct Camera of camera.wgsl; one that is not finite sees nothing."""
    rows = viewmat[:3].numpy().astype(np.float32)
    if not np.isfinite(rows).all():
        rows = np.zeros((3, 4), np.float32)  # all depths are 0: behind the near plane
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    beyond = [0.5 * TANGENT_MARGIN * side for side in (width, height)]
    tangents = (
        *((-cx - beyond[0]) / fx, (width - cx + beyond[0]) / fx),
        *((-cy - beyond[1]) / fy, (height - cy + beyond[1]) / fy),
    )
    floats = np.array([*rows.ravel(), fx, fy, cx, cy, *tangents], np.float32)
    tile_rows, columns = tile_grid(width, height)
    whole = np.array([width, height, columns, tile_rows, count, 0, 0, 0], np.uint32)
    return np.concatenate([floats.view(np.uint32), whole])


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
        camera: _Camera,
        renderer: WgpuRenderer,
    ) -> tuple[Tensor, Tensor, Tensor]:
        gaussians = (means, quats, scales, opacities, colours)
        ctx.lease, ctx.camera, ctx.renderer = renderer.lease(), camera, renderer
        colours_drawn, rest, radius_px = ctx.lease.held.draw(
            _pack(*gaussians),
            camera_bits(viewmat, camera.K, camera.width, camera.height, len(means)),
            drawn_tiles(camera.active, camera.width, camera.height),
            camera.width,
            camera.height,
        )
        image = colours_drawn[..., : colours.shape[1]].contiguous()
        ctx.save_for_backward(*gaussians, viewmat, image, rest)
        ctx.mark_non_differentiable(radius_px)
        return image, 1.0 - rest, radius_px

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        g_image: Tensor,  # [H, W, C]
        g_alpha: Tensor,  # [H, W]
        *_: Tensor,  # [...] of what has no gradient
    ) -> tuple[Any, ...]:
        *inputs, image, rest = ctx.saved_tensors
        channels = image.shape[2]
        incoming = torch.zeros(*rest.shape, 4)
        incoming[..., :channels] = g_image
        behind = (image * g_image).sum(2) - rest * g_alpha
        try:
            rows, viewmat = ctx.lease.held.differentiate(behind.numpy(), incoming.numpy())
        except Exception as error:  # as in drawing
            ctx.renderer.leave_gpu(error)
            found = ctx.renderer.gradients_on_processor(inputs, ctx.camera, g_image, g_alpha)
            return (*found, None, None)
        colours = rows[:, COLOURS][:, :channels]
        parts = (rows[:, MEAN], rows[:, QUAT], rows[:, SCALES], rows[:, OPACITY][:, 0], colours)
        return (*(part.contiguous() for part in parts), viewmat, None, None)


def _pack(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colours: Tensor,  # [N, C]
) -> npt.NDArray[np.float32]:
    """[N, ROW], as the kernels have them."""
    rows = torch.zeros(len(means), ROW)
    rows[:, MEAN], rows[:, QUAT], rows[:, SCALES] = means, quats, scales
    rows[:, OPACITY], rows[:, COLOURS][:, : colours.shape[1]] = opacities[:, None], colours
    packed: npt.NDArray[np.float32] = rows.numpy()
    return packed
