"""Pressure: how far the body lies below the surface, so metres along gravity."""

from __future__ import annotations

import numpy as np

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors.factor import MOST, Array, Factor
from aquaflow.telemetry.noise import Process, SlowPart
from aquaflow.telemetry.state import CAMERA, SCALE, SHIFT, TURN, MetricState
from aquaflow.telemetry.telemetry import Series

SIGMA_M = 0.01
"""m, white: Bar30 (MS5837-30BA) resolves 2 mm; over MAVLink its short-term noise is about 1 cm."""


class DepthFactor(Factor):
    """z of the body in n minus the depth."""

    kind = "depth"
    slow = SlowPart(
        0.007,
        60.0,
        (
            *(Process(time_s) for time_s in (2.0, 8.0, 60.0)),
            *(Process(20.0, period_s) for period_s in (2.5, 3.2, 4.0, 5.0, 6.5, 8.5, 11.0)),
        ),
    )
    """m: tide, temperature and the camera's own drift; waves reach down to half their length."""
    spans = (SCALE, TURN, SHIFT, CAMERA)

    def __init__(self, depth: Series, path: CameraPath) -> None:
        """``path`` covers all samples."""
        depth = depth.thin(MOST)
        self.source, self.t_s = depth.source, depth.t_s
        self.sigma = np.full(len(depth), SIGMA_M)
        self._depth_m = depth.values[:, 0]
        self._R_mc, self._p_m = path.at(depth.t_s)

    def residuals(self, state: MetricState) -> Array:
        """[N, 1] m."""
        _, p_n = state.body(self._R_mc, self._p_m)
        return np.asarray(p_n[:, 2:] - self._depth_m[:, None])
