"""The compiled kernels of the CPU in gsplat's place, drawing a map on the pretended device.

A kernel of a device reads and writes the device's memory, which here is the CPU's: nothing crosses.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor

from aquaflow.render import gsplat
from aquaflow.render.contract import Rendering, check_devices, check_inputs
from aquaflow.render.cpu import CpuRenderer
from tests.pretended_device import DEVICE, PRETENDED, Pretended


class KernelsOfTheDevice:
    """Draws like the CPU's renderer on one thread, bit for bit, on the pretended device."""

    name, isa, threads = "gsplat", "pretended", 1
    device = PRETENDED

    def __init__(self) -> None:
        self._cpu = CpuRenderer(1)

    def __call__(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colours: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        active: Tensor | None = None,
    ) -> Rendering:
        check_inputs(means, quats, scales, opacities, colours, viewmat, K, width, height, active)
        given = (means, quats, scales, opacities, colours, viewmat)
        check_devices(self.device, *given, K, active)
        rest = (_values(K), width, height, None if active is None else _values(active))
        return Rendering(*_Drawn.apply(self._cpu, rest, *given))  # type: ignore[no-untyped-call]


@contextmanager
def machine_with(device: torch.device) -> Iterator[None]:
    """Within it the renderer ``auto`` is that of the pretended ``device``, as on a machine with
    CUDA and gsplat; or the CPU's, as on a machine without."""
    with pytest.MonkeyPatch.context() as patch:
        if device == PRETENDED:
            patch.setattr(gsplat, "available", lambda: True)
            patch.setattr(gsplat, "GsplatRenderer", KernelsOfTheDevice)
            # On a real one it is the fastest, which nobody can measure here.
            patch.setattr("aquaflow.render._measured", lambda _: KernelsOfTheDevice())
        yield


class _Drawn(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, renderer: CpuRenderer, rest: tuple[Any, ...], *given: Tensor) -> Any:
        DEVICE.call()
        leaves = [_values(tensor).detach().requires_grad_() for tensor in given]
        with torch.enable_grad():
            drawn = renderer(*leaves, *rest)
        ctx.kept = leaves, [drawn.image, drawn.alpha]
        found = (drawn.image, drawn.alpha, drawn.visible, drawn.radius_px)
        image, alpha, *others = (Pretended(tensor.detach()) for tensor in found)
        ctx.mark_non_differentiable(*others)
        return image, alpha, *others

    @staticmethod
    def backward(ctx: Any, g_image: Tensor, g_alpha: Tensor, *_: Tensor) -> Any:
        DEVICE.call()
        leaves, drawn = ctx.kept
        incoming = [_values(g_image), _values(g_alpha)]
        return None, None, *map(Pretended, torch.autograd.grad(drawn, leaves, incoming))


def _values(tensor: Tensor) -> Tensor:
    assert isinstance(tensor, Pretended)
    return tensor.inner
