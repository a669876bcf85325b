"""Speed means nothing for a wrong gradient: each kernel against the float64 reference."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from aquaflow.evaluation.bench.render.scene import NAMES, SplatScene
from aquaflow.render.contract import Renderer
from aquaflow.render.reference import ReferenceRenderer


def gradient_errors(renderers: Sequence[Renderer], scene: SplatScene) -> dict[str, float]:
    """Input -> largest relative L2 error of its gradient among ``renderers``; none: empty."""
    if not renderers:
        return {}
    exact = _gradients(ReferenceRenderer(), scene, torch.float64)
    worst = dict.fromkeys(NAMES, 0.0)
    for renderer in renderers:
        found = _gradients(renderer, scene, torch.float32)
        for name, got, wanted in zip(NAMES, found, exact, strict=True):
            error = float((got.double() - wanted).norm() / wanted.norm())
            worst[name] = max(worst[name], error)
    return worst


def _gradients(renderer: Renderer, scene: SplatScene, dtype: torch.dtype) -> tuple[Tensor, ...]:
    leaves = scene.leaves(dtype=dtype)
    drawn = scene.drawn_by(renderer, leaves)
    incoming = [scene.g_image.to(dtype), scene.g_alpha.to(dtype)]
    return torch.autograd.grad([drawn.image, drawn.alpha], leaves, incoming)
