"""Lengths that somebody knows: the side of a marker, two laser dots, a scale bar."""

from __future__ import annotations

import numpy as np

from aquaflow.fusion.factors.factor import Array, Factor
from aquaflow.fusion.noise import Process, SlowPart
from aquaflow.fusion.state import SCALE, State


class LengthFactor(Factor):
    """Length in the map, in metres, minus the known one."""

    kind = "length"
    slow = SlowPart(1e-4, 1.0, (Process(1.0),))
    """m: what is printed and measured is right to a tenth of a millimetre at best."""
    spans = (SCALE,)

    def __init__(
        self,
        source: str,
        map_lengths: Array,  # [N] map units
        map_sigma: Array,  # [N] map units
        lengths_m: Array,  # [N] m
        sigma_m: Array,  # [N] m
    ) -> None:
        self.source, self._map, self._m = source, map_lengths, lengths_m
        self.t_s = 100.0 * np.arange(len(map_lengths), dtype=np.float64)  # each on its own
        scale = float(np.median(lengths_m / map_lengths))
        self.sigma = np.hypot(sigma_m, scale * map_sigma)

    def residuals(self, state: State) -> Array:
        """[N, 1] m."""
        return np.asarray((state.scale * self._map - self._m)[:, None])
