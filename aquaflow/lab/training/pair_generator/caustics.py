"""Sunlight gathered by waves, drawn at each use of a pair: shallow water, where it moves fast."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.noise import periodic, spectral, wrapped
from aquaflow.lab.training.pair_generator.render import median_depth
from aquaflow.lab.training.pairs import Pair, ViewBatch

TEXELS = 128
"""Along a side of the periodic pattern."""
PERIOD = (0.8, 4.0)
"""Of the pattern, in median depths of the scene."""
STRENGTH = (0.3, 1.0)
"""Share of the light that the waves move about."""
SLOPE = (1.6, 2.6)
"""Of the waves' power spectrum: from short to long-crested."""
BRIGHTEST = 3.5
"""Of the gathered light, relative to the mean."""


def with_caustics(draw: Draw, pair: Pair) -> Pair:
    """The pair's radiances under light that has moved on between the two pictures."""
    batch = len(pair.a.K)
    depth = median_depth(pair.a)[:, None, None]
    period = draw.log_uniform(batch, 1, 1, low=PERIOD[0], high=PERIOD[1]) * depth
    strength = draw.uniform(batch, 1, 1, low=STRENGTH[0], high=STRENGTH[1])
    waves = spectral(draw, TEXELS, draw.uniform(batch, low=SLOPE[0], high=SLOPE[1]))
    light = torch.exp(-draw.uniform(batch, 1, 1, low=2.0, high=6.0) * waves.abs())
    light = (light / light.mean(dim=(1, 2), keepdim=True)).clamp_max(BRIGHTEST)
    pattern = wrapped(light[:, None])
    views = []
    for view in (pair.a, pair.b):
        moved = draw.uniform(batch, 1, 2)
        gathered = periodic(pattern, _places(view) / period + moved)
        shade = 1.0 + strength * (gathered - 1.0)
        views.append(replace(view, image=view.image * shade.view(batch, 1, *view.depth.shape[1:])))
    return Pair(*views)


def _places(view: ViewBatch) -> Tensor:
    """[B, H * W, 2] metres in the world's horizontal plane; waves are overhead."""
    points = view.points().flatten(1, 2) @ view.T_wc[:, :3, :3].mT + view.T_wc[:, None, :3, 3]
    return points[..., :2] + 0.3 * points[..., 2:]
