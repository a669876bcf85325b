"""What colours an ortho shows: the scene without its water, or through a stated depth of it.

Without water, a pixel is what restoration makes of it at the range from which the nearest view saw
it (mapping/restoration.py): no channel is amplified beyond what its light there allows, and a
channel of which the pictures had too little follows the others.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.dive.restored import exposure_of_looks
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import mean_water, restored_radiance, to_bytes
from aquaflow.render.transfers import picture_out, water_in

Array = npt.NDArray[np.float64]


class Colours:
    """Turns a map's radiance into the colours of an ortho."""

    def __init__(self, mapper: Mapper, unit: float, water_range: float | None) -> None:
        """``unit``: of the ground's lengths for each map unit; ``water_range``: of the water to
        look through, in the ground's unit, or None for no water."""
        self._scene, self._unit, self._through = mapper.scene, unit, water_range
        self._water = mean_water(mapper.scene, mapper.views)
        self._exposure = exposure_of_looks(mapper) if water_range is None else 1.0

    @property
    def device(self) -> torch.device:
        """Of the map, and of the radiance that is handed in."""
        return self._scene.device

    @torch.no_grad()
    def of(
        self,
        radiance: Tensor,  # [h, w, 3] J
        nearest: Array,  # [h, w] range of the nearest view, ground's unit; infinite: none
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """Colours [h, w, 3], and what share of them was restored from light [h, w] in [0, 1]."""
        sure = np.ones(nearest.shape, np.float32)
        if self._water is None:
            return to_bytes(self._exposure * picture_out(radiance)), sure
        seen_from = nearest if self._through is None else np.full(nearest.shape, self._through)
        z = np.where(np.isfinite(seen_from), seen_from, 0.0) / self._unit
        ranges = water_in(z, radiance.device)
        if self._through is not None:
            water = self._water
            seen = radiance * water.transmission(ranges) + water.backscatter(ranges)
            return to_bytes(picture_out(seen)), sure
        recovered = restored_radiance(self._scene, radiance, ranges, self._water)
        return (
            to_bytes(self._exposure * picture_out(recovered.picture)),
            picture_out(recovered.confidence).astype(np.float32),
        )
