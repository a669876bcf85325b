"""No source: the vehicle is taken to keep its depth, where nothing else says what is down."""

from __future__ import annotations

import numpy as np

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors.factor import MOST, Array, Factor
from aquaflow.telemetry.noise import Process, SlowPart
from aquaflow.telemetry.state import CAMERA, SCALE, TURN, MetricState


class ConstantDepthFactor(Factor):
    """z of the body in n minus its mean, m."""

    kind = "constant_depth"
    slow = SlowPart(0.05, 20.0, tuple(Process(t) for t in (5.0, 20.0, 100.0)))
    """m: a vehicle that follows the ground goes up and down for as long as a slope lasts."""
    spans = (SCALE, TURN, CAMERA)

    def __init__(self, path: CameraPath, sigma_m: float) -> None:
        step = max(1, -(-len(path) // MOST))
        self.source, self.t_s = "assumed", path.t_s[::step]
        self.sigma = np.full(len(self.t_s), sigma_m)
        self._R_mc, self._p_m = path.R_mc[::step], path.p_m[::step]

    def residuals(self, state: MetricState) -> Array:
        """[N, 1] m."""
        _, p_n = state.body(self._R_mc, self._p_m)
        return np.asarray(p_n[:, 2:] - p_n[:, 2:].mean())
