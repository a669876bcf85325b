"""What each Gaussian looks like in each picture: its colour as the camera saw it, and its range.

The derivative of a rendered picture with respect to a Gaussian's colour is its blending weight at
every pixel. Weighing the real picture with it gives the colour seen over the Gaussian's own
footprint, occlusion included, in far views and near ones over the same piece of sea floor.

A footprint takes in some of the neighbours, more of them from afar, and contrast that is lost to
them looks like water. How the neighbours change the colour is known from the map itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.mapping.gaussians.gaussians import radiance
from aquaflow.mapping.views import View
from aquaflow.mapping.water.grouping import mean_by
from aquaflow.mapping.water.observations import Observations
from aquaflow.render.contract import Renderer

SeenFrom = Callable[[View], Mapping[str, Tensor]]
"""The parameters of a GaussianMap as a view sees them."""

POINTS = 800
"""Gaussians looked at, three times as many cost three times the time: on IUI3, the reef and Curasao
2,500 give log beta_a within its sigma of what 800 give."""
LEAST_SPAN = 0.1
"""Added to the log of largest over smallest range, by which Gaussians are drawn: those seen from
near and far say most, those seen from one range alone something of the scene's colours."""
MIN_WEIGHT_PX = 3.0
"""Sum of blending weights below which a Gaussian is hardly in the picture."""
MIN_VIEWS = 4
"""Views that must see a Gaussian for it to say anything about the water."""
BORDER = 0.97
"""Gaussians whose centre is further out than this share of the picture are cut by its edge."""

HALF_SOLID = 0.5
"""Alpha below which the map says little of what is there."""


def sight(
    seen_from: SeenFrom,
    views: list[View],
    renderer: Renderer,
    generator: torch.Generator,
    beta_a: npt.NDArray[np.float64],  # [3] per map unit, of the water that the map was made for
) -> Observations:
    """Sightings of a random choice of the Gaussians that several of ``views`` see well.

    Raises:
        ArithmeticError: a range is not a number.
    """
    seen = [_sighting(seen_from(view), view, renderer) for view in views]
    weight = torch.stack([sighting[0] for sighting in seen])
    good = weight > MIN_WEIGHT_PX
    candidates = torch.nonzero(good.sum(0) >= MIN_VIEWS)[:, 0]
    ranges = torch.stack([sighting[2] for sighting in seen])[:, candidates]
    chosen = candidates[_drawn(ranges, good[:, candidates], generator)]
    view_of, number = torch.nonzero(good[:, chosen], as_tuple=True)
    row = chosen[number]
    colour, z, xy, blend = (
        torch.stack([sighting[k] for sighting in seen])[view_of, row].double().numpy()
        for k in range(1, 5)
    )
    point = number.numpy()
    own_range = mean_by(point, z[:, None])[point]
    # Other water would need another map to look the same, but what is seen is seen.
    blend = (blend - mean_by(point, blend)[point]) * np.exp(-beta_a * own_range)
    positions = seen_from(views[0])["means"][chosen].double().numpy()
    return Observations(point, view_of.numpy(), colour, z, xy, blend, positions)


def _drawn(
    ranges: Tensor,  # [V, N] map units
    good: Tensor,  # [V, N] bool
    generator: torch.Generator,
) -> Tensor:
    """[P] which of N Gaussians are looked at, in their order: P = POINTS, or all."""
    if ranges.shape[1] <= POINTS:
        return torch.arange(ranges.shape[1])
    low = torch.where(good, ranges, torch.inf).amin(0)
    high = torch.where(good, ranges, 0.0).amax(0)
    weight = LEAST_SPAN + torch.log(high / low)
    if not bool(torch.isfinite(weight).all()):
        raise ArithmeticError("a range is not a number")
    return torch.multinomial(weight, POINTS, generator=generator).sort().values


def _sighting(
    parameters: Mapping[str, Tensor],  # of a GaussianMap
    view: View,
    renderer: Renderer,
) -> tuple[Tensor, ...]:
    """Of every Gaussian in one view: weight [N] px, colour [N, 3], range [N], picture position
    [N, 2], and the map's clean colour over the same footprint [N, 3]."""
    means = parameters["means"]
    clean = radiance(parameters["raw_colours"])
    colours = torch.cat([clean, torch.ones_like(clean[:, :1])], dim=-1).requires_grad_()
    drawn = renderer(
        means,
        parameters["quats"],
        torch.exp(parameters["log_scales"]),
        torch.sigmoid(parameters["opacity_logits"][:, 0]),
        colours,
        view.viewmat(),
        view.K(),
        view.camera.width,
        view.camera.height,
    )
    one = torch.ones_like(drawn.alpha[..., None])
    weighed = [
        torch.autograd.grad((drawn.image * picture).sum(), colours, retain_graph=True)[0]
        for picture in (
            torch.cat([view.target(), one], dim=-1),
            drawn.image.detach() / drawn.alpha.detach().clamp_min(HALF_SOLID)[..., None],
        )
    ]
    local = (means.double().numpy() - view.T_wc.t) @ view.T_wc.R
    half = np.array([view.camera.width, view.camera.height]) / 2.0
    xy = torch.from_numpy(view.camera.project(local) / half - 1.0)
    inside = (xy.abs() < BORDER).all(dim=-1)
    sums = weighed[0][:, 3]
    seen, blend = (part[:, :3] / sums[:, None].clamp_min(1e-6) for part in weighed)
    z = torch.from_numpy(np.linalg.norm(local, axis=1))
    return torch.where(inside, sums, 0.0), seen, z, xy, blend
