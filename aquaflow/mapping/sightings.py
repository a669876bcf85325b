"""What each Gaussian looks like in each picture: its colour as the camera saw it, and its range.

The derivative of a rendered picture with respect to a Gaussian's colour is its blending weight at
every pixel. Weighing the real picture with it gives the colour seen over the Gaussian's own
footprint, occlusion included, in far views and near ones over the same piece of sea floor.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from aquaflow.mapping.gaussians import GaussianMap
from aquaflow.mapping.views import View
from aquaflow.mapping.water_estimation import Observations
from aquaflow.render.contract import Renderer

POINTS = 2500
"""Gaussians looked at; more change nothing and cost time."""
MIN_WEIGHT_PX = 3.0
"""Sum of blending weights below which a Gaussian is hardly in the picture."""
MIN_VIEWS = 4
BORDER = 0.97
"""Gaussians whose centre is further out than this share of the picture are cut by its edge."""


def sight(
    gaussians: GaussianMap,
    views: list[View],
    renderer: Renderer,
    generator: torch.Generator,
) -> Observations:
    """Sightings of a random choice of the Gaussians that several of ``views`` see well."""
    seen = [_sighting(gaussians, view, renderer) for view in views]
    weight = torch.stack([sighting[0] for sighting in seen])
    good = weight > MIN_WEIGHT_PX
    candidates = torch.nonzero(good.sum(0) >= MIN_VIEWS)[:, 0]
    order = torch.randperm(len(candidates), generator=generator)[:POINTS]
    chosen = candidates[order.sort().values]
    view_of, number = torch.nonzero(good[:, chosen], as_tuple=True)
    row = chosen[number]
    return Observations(
        number.numpy(),
        torch.stack([sighting[1] for sighting in seen])[view_of, row].double().numpy(),
        torch.stack([sighting[2] for sighting in seen])[view_of, row].double().numpy(),
        torch.stack([sighting[3] for sighting in seen])[view_of, row].double().numpy(),
    )


def _sighting(
    gaussians: GaussianMap, view: View, renderer: Renderer
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weight [N] px, colour [N, 3], range [N] and picture position [N, 2] in one view."""
    colours = torch.zeros(len(gaussians), 4, requires_grad=True)
    drawn = renderer(
        gaussians.means,
        gaussians.parameters["quats"],
        gaussians.scales,
        gaussians.opacities,
        colours,
        view.viewmat(),
        view.K(),
        view.camera.width,
        view.camera.height,
    )
    target = view.target()
    picture = torch.cat([target, torch.ones_like(target[..., :1])], dim=-1)
    (sums,) = torch.autograd.grad((drawn.image * picture).sum(), colours)
    local = (gaussians.means.double().numpy() - view.T_wc.t) @ view.T_wc.R
    half = np.array([view.camera.width, view.camera.height]) / 2.0
    xy = torch.from_numpy(view.camera.project(local) / half - 1.0)
    inside = (xy.abs() < BORDER).all(dim=-1)
    weight = torch.where(inside, sums[:, 3], 0.0)
    z = torch.from_numpy(np.linalg.norm(local, axis=1))
    return weight, sums[:, :3] / sums[:, 3:].clamp_min(1e-6), z, xy
