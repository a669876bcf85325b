"""What the blending loops do where nothing is in vain: the limit of their mix of instructions.

The processor's peak counts fused multiply-adds alone. Blending one Gaussian into one pixel also
takes an exponential, comparisons, masks, loads and stores, and backward a division, which fill the
same units and count as one operation or none. How much of the peak is left for that mix is measured
with the loops themselves: on a picture so small that all data is in the first caches, with
Gaussians that reach every pixel of every tile.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from aquaflow.lab.bench.render.timing import torch_threads
from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.example_scene import Size, SplatScene, height_field

COVERING = Size(100, 64, 64)
"""Sixteen tiles; at an alpha of OPACITY the last Gaussian still finds a transmittance of 0.006."""
OPACITY = 0.05
SIGMA = 50.0
"""Standard deviation, in ranges of the nearest: alpha is the same all over the picture."""
ATTEMPTS = 25
"""The fastest counts; each takes a millisecond."""
FORWARD_STAGE, BACKWARD_STAGE = "blend", "blend backward"


@dataclass(frozen=True)
class BlendLimit:
    """Pairs of a pixel and a Gaussian that one thread blends in a second, at most."""

    fwd: float
    bwd: float

    def seconds(self, interactions: int) -> dict[str, float]:
        """The least that ``interactions`` take one thread, by pass."""
        return {"fwd": interactions / self.fwd, "bwd": interactions / self.bwd}


def covering_scene() -> SplatScene:
    """COVERING, with Gaussians one behind the other that all reach every pixel."""
    scene, n = height_field(COVERING), COVERING.n
    means, scales = torch.zeros(n, 3), torch.full((n, 3), SIGMA)
    means[:, 2], scales[:, 2] = torch.linspace(1.0, 2.0, n), 1e-3
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    colours = scene.inputs[4]
    inputs = (means, quats, scales, torch.full((n,), OPACITY), colours, torch.eye(4))
    return replace(scene, inputs=inputs)


def measure_blend_limit(isa: str) -> BlendLimit:
    """By the kernels of ``isa``, on one thread; their own clock, the fastest of ATTEMPTS."""
    renderer, scene = CpuRenderer(1, isa), covering_scene()
    leaves, fastest = scene.leaves(), {FORWARD_STAGE: float("inf"), BACKWARD_STAGE: float("inf")}
    with torch_threads(1):
        for _ in range(ATTEMPTS):
            drawn = scene.drawn_by(renderer, leaves)
            torch.autograd.grad([drawn.image, drawn.alpha], leaves, [scene.g_image, scene.g_alpha])
            stages = renderer.stage_ms()
            fastest = {name: min(ms, stages[name]) for name, ms in fastest.items()}
    pairs = COVERING.n * COVERING.pixels
    forward, backward = (1e-3 * fastest[name] for name in (FORWARD_STAGE, BACKWARD_STAGE))
    return BlendLimit(pairs / forward, pairs / backward)
