"""An altimeter: its range against the map's own range along its beam."""

from __future__ import annotations

import numpy as np

from aquaflow.fusion.camera_path import CameraPath
from aquaflow.fusion.factors.factor import Array, Factor
from aquaflow.fusion.noise import Process, SlowPart
from aquaflow.fusion.state import SCALE, State
from aquaflow.fusion.telemetry import Series

MOST_BEAMS = 100
"""Samples that are compared with the map: each looks through all of its points."""
HALF_BEAM = np.radians(12.5)
"""rad: Ping sonar, 25 degrees at -3 dB."""
FIRST_RETURN = 1.0
"""Percentile of the ranges within the beam: an echo sounder hears what is nearest (measured on a
synthetic reef: 0.5 % too far, where the 10th is 4 % too far), and a map's nearest are outliers."""
LEAST_POINTS = 30
"""Of the map within a beam; fewer are no ground."""
SIGMA_M, SHARE = 0.01, 0.02
"""1 sigma, m and share of the range: Ping sonar 0.5 % resolution, roughness within the beam."""


class AltitudeFactor(Factor):
    """Range to the map along the beam minus the altitude, m."""

    kind = "altitude"
    slow = SlowPart(0.01, 5.0, tuple(Process(t) for t in (1.0, 5.0, 30.0)))
    """m: the same rock stays within the beam for seconds."""
    spans = (SCALE,)

    def __init__(
        self,
        altitude: Series,
        path: CameraPath,
        points_m: Array,  # [K, 3] of the map
        state: State,
    ) -> None:
        """Keeps the samples whose beam meets the map at the body's pose in ``state``; the beam
        looks along the body's z. ``path`` covers all samples."""
        altitude = altitude.thinned(MOST_BEAMS)
        R_mc, p_m = path.at(altitude.t_s)
        down = (R_mc @ state.R_bc.T)[:, :, 2]
        body = p_m - (R_mc @ (state.R_bc.T @ state.c_b)) / state.scale
        ranges = np.array([_first_return(points_m, *beam) for beam in zip(body, down, strict=True)])
        met = np.isfinite(ranges)
        self.source, self.t_s = altitude.source, altitude.t_s[met]
        self._range, self._altitude_m = ranges[met], altitude.values[met, 0]
        self.sigma = np.hypot(SIGMA_M, SHARE * self._altitude_m)

    @property
    def rough_log_scale(self) -> float:
        """Of metres per map unit, from the median of the ratios."""
        return float(np.log(np.median(self._altitude_m / self._range)))

    def residuals(self, state: State) -> Array:
        """[N, 1] m."""
        return np.asarray((state.scale * self._range - self._altitude_m)[:, None])

    def scale_misfit(self, state: State) -> tuple[Array, Array]:
        """Logarithm of the scale that each range alone gives, over the state's; 1 sigma."""
        ranges = state.scale * self._range
        return -self.residuals(state)[:, 0] / ranges, self.sigma / ranges


def _first_return(
    points: Array,  # [K, 3] map
    apex: Array,  # [3] map
    axis: Array,  # [3] unit vector
) -> float:
    """Range from ``apex`` to the nearest points within the beam; NaN if it meets none."""
    away = points - apex
    along = away @ axis
    inside = along > 0.0
    away, along = away[inside], along[inside]
    ranges = np.linalg.norm(away, axis=1)
    ranges = ranges[along > np.cos(HALF_BEAM) * ranges]
    return float(np.percentile(ranges, FIRST_RETURN)) if len(ranges) >= LEAST_POINTS else np.nan
