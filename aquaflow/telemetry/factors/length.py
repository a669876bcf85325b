"""Lengths that somebody knows: the side of a marker, two laser dots, a scale bar."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aquaflow.telemetry.factors.factor import Array, Factor
from aquaflow.telemetry.known_lengths.known_length import KnownLength
from aquaflow.telemetry.noise import Process, SlowPart
from aquaflow.telemetry.state import SCALE, MetricState

APART_S, LASTING_S = 100.0, 1e9
"""Stated moments of measurements, each of which errs on its own, and the correlation time of what
they all share: the length that was measured by hand."""


class LengthFactor(Factor):
    """Lengths in the map, in metres, minus the known one."""

    kind = "length"
    spans = (SCALE,)

    def __init__(
        self,
        source: str,
        map_lengths: Array,  # [N] map units
        map_sigma: Array,  # [N] map units
        length_m: float,
        sigma_m: float,
    ) -> None:
        self.source, self._map, self._m = source, map_lengths, length_m
        self.t_s = APART_S * np.arange(len(map_lengths), dtype=np.float64)
        self.rough_scale = float(length_m / np.median(map_lengths))
        self.sigma = self.rough_scale * map_sigma
        self.slow = SlowPart(sigma_m, LASTING_S, (Process(1.0),))

    def residuals(self, state: MetricState) -> Array:
        """[N, 1] m."""
        return np.asarray((state.scale * self._map - self._m)[:, None])


def length_factors(lengths: Sequence[KnownLength]) -> list[LengthFactor]:
    """The known lengths of one sub-map, as one factor for each that was measured by hand."""
    groups: dict[float, list[KnownLength]] = {}
    for length in lengths:
        groups.setdefault(length.length_m, []).append(length)
    return [
        LengthFactor(
            ", ".join(sorted({each.source for each in group})),
            np.array([each.map_length for each in group]),
            np.array([each.map_sigma for each in group]),
            length_m,
            float(np.median([each.sigma_m for each in group])),
        )
        for length_m, group in groups.items()
    ]
