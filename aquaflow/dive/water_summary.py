"""The water of a finished sub-map in numbers, from its map."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from aquaflow.dive.results import WaterSummary
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.contract import CPU
from aquaflow.render.transfers import picture_out, water_in, water_out
from aquaflow.render.views import View
from aquaflow.water.medium import WaterParameters
from aquaflow.water.sightings import SOLID

RANGE_PERCENTILES = (5.0, 95.0)
"""Percent; values outside are single pixels at edges of the map."""
RANGE_VIEWS = 100
"""Most views that the span of ranges is taken from."""


@torch.no_grad()
def summarise_water(mapper: Mapper, most_views: int = RANGE_VIEWS) -> WaterSummary | None:
    """Mean medium over the views and the ranges they span; None while the medium is off."""
    if not mapper.medium.active or not mapper.views or len(mapper.gaussians) == 0:
        return None
    waters = [water for view in mapper.views if (water := mapper.scene.water(view)) is not None]
    looked_at = mapper.views[:: _step(mapper, most_views)]
    z = torch.cat([_solid_ranges(mapper, view) for view in looked_at])
    if len(z) == 0:
        return None
    low, high = np.percentile(picture_out(z), RANGE_PERCENTILES)
    first = waters[0]
    summary = WaterSummary(
        water_out(torch.stack([water.beta_a for water in waters]).mean(0)).tolist(),
        water_out(first.b).tolist(),
        water_out(first.B_inf).tolist(),
        water_out(first.B_res).tolist(),
        water_out(first.d).tolist(),
        float(low),
        float(z.median()),
        float(high),
        water_out(mapper.scene.white_gain()).tolist(),
        None if mapper.scene.balance is None else mapper.scene.balance.near_range,
        mapper.scene.range_variance,
        mapper.scene.beta_a_sigma,
        mapper.scene.shading.tolist(),
        mapper.scene.unevenness().tolist(),
    )
    numbers = (low, high, summary.range_median, *summary.beta_a, *summary.B_inf, *summary.b)
    if not np.isfinite(numbers).all():
        raise ArithmeticError("the water's summary is not finite")
    return summary


def attenuations(mappers: Mapping[int, Mapper]) -> dict[int, list[float]]:
    """Per map unit, of each channel, by sub-map; without water none. In the maps' thread."""
    found = {}
    for number, mapper in mappers.items():
        water = mapper.scene.water(mapper.views[-1]) if mapper.views else None
        if water is not None:
            found[number] = water_out(water.beta_a).ravel().tolist()
    return found


def _step(mapper: Mapper, most: int) -> int:
    """Every tenth view is enough for the span of ranges."""
    return max(10, -(-len(mapper.views) // most))


def _solid_ranges(mapper: Mapper, view: View) -> torch.Tensor:
    shown = mapper.show(view)
    return shown.z[shown.alpha > SOLID]


def water_of(summary: WaterSummary, device: torch.device = CPU) -> WaterParameters:
    """The summary as tensors."""
    fields = (summary.beta_a, summary.B_inf, summary.b, summary.B_res, summary.d)
    return WaterParameters(*(water_in(values, device) for values in fields))
