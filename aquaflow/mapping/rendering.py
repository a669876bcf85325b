"""One picture of the map: clean radiance and range from the renderer, then the water."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from aquaflow.render.activation import activate
from aquaflow.render.contract import Renderer
from aquaflow.render.views import View
from aquaflow.render.water import MIN_SOLID, compose_water
from aquaflow.water.image_formation import WaterParameters


@dataclass(frozen=True)
class RenderedMap:
    """The map from one view."""

    image: Tensor
    """[H, W, 3] I-hat, through the water and with the camera's shading."""
    radiance: Tensor
    """[H, W, 3] J-tilde, without water, premultiplied by alpha."""
    alpha: Tensor
    """[H, W]"""
    z: Tensor
    """[H, W] range along the ray, map units; meaningless where alpha is near 0."""
    visible: Tensor
    """[N] bool"""
    radius_px: Tensor
    """[N]"""
    active: Tensor | None = None
    """[rows, columns] bool, the tiles that were drawn; None: all."""


def show(
    parameters: Mapping[str, Tensor],  # of a GaussianMap
    water: WaterParameters | None,
    gain: Tensor | None,  # [H, W] shading
    renderer: Renderer,
    view: View,
    viewmat: Tensor,  # [4, 4] world to camera
    active: Tensor | None = None,  # [rows, columns] bool, the tiles to draw
    uneven: Tensor | None = None,  # [H, W] gain of the backscatter
) -> RenderedMap:
    """Draw the map; differentiable in the parameters, the water and the view matrix.

    Range rides as a fourth colour channel divided by alpha, the same on every renderer.
    """
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    activated = activate(
        parameters["means"],
        parameters["log_scales"],
        parameters["opacity_logits"],
        parameters["raw_colours"],
        centre,
        renderer.threads,
    )
    drawn = renderer(
        parameters["means"],
        parameters["quats"],
        *activated,
        viewmat,
        view.K(),
        view.camera.width,
        view.camera.height,
        active,
    )
    clean = drawn.image[..., :3]
    if water is None:
        z = drawn.image[..., 3] / drawn.alpha.clamp_min(MIN_SOLID)
        image = clean if gain is None else clean * gain[..., None]
    else:
        image, z = compose_water(
            drawn.image, drawn.alpha, water.stack(), renderer.threads, uneven, gain
        )
    return RenderedMap(image, clean, drawn.alpha, z, drawn.visible, drawn.radius_px, active)
