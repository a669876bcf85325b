"""Fixes on the earth: GNSS at the surface, USBL or another acoustic system below."""

from __future__ import annotations

import numpy as np

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors.factor import MOST, Array, Factor
from aquaflow.telemetry.noise import Process, SlowPart
from aquaflow.telemetry.state import CAMERA, LAG, SCALE, SHIFT, TURN, MetricState


class PositionFactor(Factor):
    """North and east of the body, at the moment that the fix is of, minus the fix, m."""

    kind = "position"
    slow = SlowPart(0.001, 60.0, tuple(Process(t) for t in (10.0, 60.0, 600.0)))
    """m: GNSS and acoustic fixes err for minutes; how much differs by system, their residuals say.
    """
    spans = (SCALE, TURN, SHIFT, CAMERA, LAG)

    def __init__(
        self,
        source: str,
        t_s: Array,  # [N] s
        fixes_n: Array,  # [N, 2] m, north and east of n's origin
        sigma: Array,  # [N] m
        path: CameraPath,
    ) -> None:
        """``path`` covers all fixes."""
        step = max(1, -(-len(t_s) // MOST))
        self.source, self.t_s, self.sigma = source, t_s[::step], sigma[::step]
        self._fixes_n = fixes_n[::step]
        self._R_mc, self._p_m = path.at(self.t_s)
        self._v_m = path.velocity(self.t_s)

    def residuals(self, state: MetricState) -> Array:
        """[N, 2] m."""
        _, p_n = state.body(self._R_mc, self._p_m - state.lag_s * self._v_m)
        return np.asarray(p_n[:, :2] - self._fixes_n)


class PlaceFactor(PositionFactor):
    """The one place at which dead reckoning puts the body when a sub-map starts."""

    kind = "dead_reckoning"
    slow = SlowPart(1e-4, 1.0, (Process(1.0),))
    """m: all of its uncertainty is in its sigma."""
