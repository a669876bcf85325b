"""Small random scenes, and the comparison of a renderer with the float64 reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import pytest
import torch
from torch import Tensor

from aquaflow.render.contract import CPU, Renderer, Rendering
from aquaflow.render.cpu import CpuRenderer, TileRenderer
from aquaflow.render.native import build as native
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.render.webgpu import WgpuRenderer
from aquaflow.render.webgpu_device import missing

needs_compiler = pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")
no_adapter = missing()
needs_adapter = pytest.mark.skipif(no_adapter is not None, reason=str(no_adapter))
RENDERERS = [
    *(pytest.param(isa, marks=needs_compiler) for isa in native.supported_isas()),
    "tiles",
    pytest.param("wgpu", marks=needs_adapter),
]
"""The renderers that this machine may have, for :func:`make`."""


def make(kind: str, threads: int = 2) -> Renderer:
    """The renderer of this name, or the processor's with this instruction set."""
    if kind == "reference":
        return ReferenceRenderer()
    others = {"tiles": TileRenderer, "wgpu": WgpuRenderer}
    return others[kind]() if kind in others else CpuRenderer(threads, kind)


WIDTH, HEIGHT = 52, 39  # no multiple of a tile or block


@dataclass(frozen=True)
class Scene:
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colours: Tensor
    viewmat: Tensor
    K: Tensor

    def leaves(
        self, dtype: torch.dtype = torch.float32, device: torch.device = CPU
    ) -> list[Tensor]:
        """Copies in field order, all but K requiring gradients."""
        named = [getattr(self, field.name) for field in fields(self)]
        tensors = [tensor.detach().clone().to(device, dtype) for tensor in named]
        return [tensor.requires_grad_(i < 6) for i, tensor in enumerate(tensors)]


NAMES = [field.name for field in fields(Scene)][:6]


def random_scene(seed: int = 0, n: int = 120, channels: int = 4, sigma_m: float = 0.06) -> Scene:
    """Gaussians 1 to 4 m before a camera that is turned and shifted."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=rng)

    depth = uniform(1.0, 4.0, n)
    rays = torch.stack([uniform(-0.65, 0.65, n), uniform(-0.5, 0.5, n), torch.ones(n)], 1)
    turn, tilt = 0.5, -0.2
    about_y = torch.tensor(
        [
            [math.cos(turn), 0.0, math.sin(turn)],
            [0.0, 1.0, 0.0],
            [-math.sin(turn), 0.0, math.cos(turn)],
        ]
    )
    about_x = torch.tensor(
        [
            [1.0, 0.0, 0.0],
            [0.0, math.cos(tilt), -math.sin(tilt)],
            [0.0, math.sin(tilt), math.cos(tilt)],
        ]
    )
    viewmat = torch.eye(4)
    viewmat[:3, :3] = about_x @ about_y
    viewmat[:3, 3] = torch.tensor([0.05, -0.03, 0.1])
    means = (rays * depth[:, None] - viewmat[:3, 3]) @ viewmat[:3, :3]
    scales = sigma_m * depth[:, None] / 2 * uniform(0.3, 1.5, n, 3)
    K = torch.tensor([[45.0, 0.0, 25.0], [0.0, 47.0, 20.5], [0.0, 0.0, 1.0]])
    return Scene(
        means,
        torch.randn(n, 4, generator=rng) * 2,
        scales,
        uniform(0.1, 1.0, n),
        torch.rand(n, channels, generator=rng),
        viewmat,
        K,
    )


def draw_and_differentiate(
    renderer: Renderer,
    scene: Scene,
    dtype: torch.dtype = torch.float32,
    active: Tensor | None = None,  # [tiles] the renderer's activity mask
    seen: Tensor | None = None,  # [H, W] pixels that count in the function; None: all
) -> tuple[Rendering, list[Tensor]]:
    """The rendering and the gradients of a random linear function of image and alpha."""
    rng = torch.Generator().manual_seed(7)
    leaves = scene.leaves(dtype, renderer.device)
    out = renderer(*leaves, WIDTH, HEIGHT, active)
    g_image = torch.randn(out.image.shape, generator=rng).to(renderer.device, dtype)
    g_alpha = torch.randn(out.alpha.shape, generator=rng).to(renderer.device, dtype)
    if seen is not None:
        g_image, g_alpha = g_image * seen[..., None], g_alpha * seen
    ((out.image * g_image).sum() + (out.alpha * g_alpha).sum()).backward()
    gradients = [torch.zeros(0) if leaf.grad is None else leaf.grad for leaf in leaves[:6]]
    return out, gradients


def reference(scene: Scene) -> tuple[Rendering, list[Tensor]]:
    return draw_and_differentiate(ReferenceRenderer(), scene, torch.float64)


def relative_error(got: Tensor, wanted: Tensor) -> float:
    """Euclidean norm of the difference over that of ``wanted``."""
    return float((got.double() - wanted.double()).norm() / wanted.double().norm())
