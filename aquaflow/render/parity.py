"""How far a renderer's picture and gradients are from the float64 reference's."""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.render.contract import Renderer
from aquaflow.render.example_scene import FARTHEST_M, NAMES, SplatScene
from aquaflow.render.reference import ReferenceRenderer

PICTURE = "picture"
"""Key of the picture's difference; the gradients' are those of NAMES."""
MOST_PICTURE = 1.0 / 255.0
"""One grey level: what drops out of the picture below MIN_ALPHA may be one renderer's and not the
other's."""
MOST_GRADIENT = 0.05
"""Of float32 kernels with fast mathematics that stop one Gaussian earlier (see GsplatRenderer); a
wrong formula differs by tens of percent."""


def drawn_and_differentiated(
    renderer: Renderer, scene: SplatScene, dtype: torch.dtype = torch.float32
) -> list[Tensor]:
    """[H, W, 5] colours, range and alpha, then the gradients of NAMES, drawn from inputs of
    ``dtype``; float64 and on the CPU, wherever the renderer draws."""
    leaves = scene.leaves(renderer.device, dtype)
    drawn = scene.drawn_by(renderer, leaves)
    incoming = [g.to(drawn.image) for g in (scene.g_image, scene.g_alpha)]
    gradients = torch.autograd.grad([drawn.image, drawn.alpha], leaves, incoming)
    picture = torch.cat([drawn.image, drawn.alpha[..., None]], 2).detach()
    return [tensor.cpu().double() for tensor in (picture, *gradients)]


def differences(renderer: Renderer, scene: SplatScene) -> dict[str, float]:
    """The picture's largest difference, in shares of the full scale of each channel and of alpha;
    for each input the relative L2 difference of its gradient."""
    found = drawn_and_differentiated(renderer, scene)
    exact = drawn_and_differentiated(ReferenceRenderer(), scene, torch.float64)
    full_scale = torch.tensor([1.0, 1.0, 1.0, FARTHEST_M, 1.0])
    picture = ((found[0] - exact[0]).abs() / full_scale).max()
    gradients = zip(NAMES, found[1:], exact[1:], strict=True)
    return {
        PICTURE: float(picture),
        **{name: float((got - wanted).norm() / wanted.norm()) for name, got, wanted in gradients},
    }


def too_far(found: dict[str, float]) -> str | None:
    """The first of ``found`` that is beyond its bound, in words; None: all agree.

    A difference that is no number is beyond every bound.
    """
    for name, difference in found.items():
        most = MOST_PICTURE if name == PICTURE else MOST_GRADIENT
        if not difference <= most:
            what = "its picture" if name == PICTURE else f"its gradient of {name}"
            return f"{what} is {difference:.1e} from the reference's, more than {most:.1e}"
    return None
