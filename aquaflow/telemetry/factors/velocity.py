"""A DVL: displacements over ground, which are metres whatever the vehicle does."""

from __future__ import annotations

import numpy as np
from scipy.integrate import cumulative_trapezoid

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors.factor import MOST, Array, Factor, axes_along
from aquaflow.telemetry.noise import Process, SlowPart
from aquaflow.telemetry.state import CAMERA, DVL, DVL_SCALE, SCALE, MetricState
from aquaflow.telemetry.telemetry import Series

INTERVAL_S = 1.0
"""Least time of a displacement: at an ROV's 0.3 m/s well above the noise of two poses."""
LONGEST_GAP_S = 0.7
"""Between two velocities inside an interval: a DVL sends 4 to 15 a second while it has the bottom.
"""
LEAST_SIGMA_M_S = 0.005
"""A figure of merit below is not believed: A50, 0.1 cm/s at best."""


class VelocityFactor(Factor):
    """Displacement of the camera between two poses minus the DVL's, m: along it, and across.

    The camera's own scale errs along the way, with the same sign after the vehicle has turned
    round; in the axes of the map such an error would seem to average out between two lanes.
    """

    kind = "velocity"
    slow = SlowPart(0.0015, 15.0, tuple(Process(t) for t in (3.0, 15.0, 60.0)))
    """m in an interval: the camera's own scale wanders along the path, by 0.3 % of 0.5 m."""
    spans = (SCALE, CAMERA, DVL, DVL_SCALE)

    def __init__(self, velocity: Series, path: CameraPath) -> None:
        """``path`` covers all samples."""
        self.source = velocity.source
        self._tau, self._v = velocity.t_s, velocity.values[:, :3]
        self._R_mc, _ = path.at(velocity.t_s)
        first, last = _intervals(velocity.t_s)
        begin, end = velocity.t_s[first], velocity.t_s[last]
        self._first, self._last = first, last
        self.t_s = 0.5 * (begin + end)
        R_begin, p_begin = path.at(begin)
        R_end, p_end = path.at(end)
        self._moved_m, self._turned = p_end - p_begin, R_end - R_begin
        self._axes = axes_along(self._moved_m)
        merit = np.maximum(velocity.values[:, 3], LEAST_SIGMA_M_S)
        spacing = (end - begin) / np.maximum(last - first, 1)
        means = np.array([merit[i : j + 1].mean() for i, j in zip(first, last, strict=True)])
        self.sigma = means * np.sqrt(spacing * (end - begin))

    def residuals(self, state: MetricState) -> Array:
        """[N, 3] m."""
        R_cb = state.R_bc.T
        v_c = np.exp(state.log_dvl) * self._v @ (R_cb @ state.R_bd).T
        v_m = np.einsum("nij,nj->ni", self._R_mc, v_c)
        way = np.asarray(cumulative_trapezoid(v_m, self._tau, axis=0, initial=0))
        arm = self._turned @ (R_cb @ state.c_b)
        body = way[self._last] - way[self._first]
        apart = state.scale * self._moved_m - body - arm
        return np.asarray(np.einsum("nij,nj->ni", self._axes, apart))

    def scale_misfit(self, state: MetricState) -> tuple[Array, Array]:
        """Logarithm of the scale that each displacement alone gives, over the state's; 1 sigma."""
        moved = np.maximum(state.scale * np.linalg.norm(self._moved_m, axis=1), 1e-6)
        return -self.residuals(state)[:, 0] / moved, self.sigma / moved


def _intervals(
    t_s: Array,  # [M] s
) -> tuple[Array, Array]:
    """[N] first and last sample of stretches of at least INTERVAL_S without a gap."""
    least = max(INTERVAL_S, (t_s[-1] - t_s[0]) / MOST) if len(t_s) else INTERVAL_S
    gaps = np.flatnonzero(np.diff(t_s) > LONGEST_GAP_S)
    first, last = [], []
    for run in np.split(np.arange(len(t_s)), gaps + 1):
        start = 0
        for k in range(1, len(run)):
            if t_s[run[k]] - t_s[run[start]] >= least:
                first.append(run[start])
                last.append(run[k])
                start = k
    return np.array(first, dtype=np.intp), np.array(last, dtype=np.intp)
