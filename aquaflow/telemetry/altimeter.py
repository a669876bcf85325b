"""An altimeter: its range against the map's own range along its beam."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import so3_exp, so3_log
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors import Factor
from aquaflow.telemetry.start import Process, SlowPart
from aquaflow.telemetry.state import CAMERA, SCALE, MetricState
from aquaflow.telemetry.telemetry import Series

Array = npt.NDArray[np.float64]

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
WIDER = np.radians(10.0)
"""rad around the beam within which points are looked through again for a turned mounting."""
TURNED = np.radians(2.0)
"""rad by which the mounting is turned to see what its error does to the ranges: on a slope, 1 % in
3 degrees."""


class AltitudeFactor(Factor):
    """Range to the map along the beam minus the altitude, m."""

    kind = "altitude"
    slow = SlowPart(0.01, 5.0, tuple(Process(t) for t in (1.0, 5.0, 30.0)))
    """m: the same rock stays within the beam for seconds."""
    spans = (SCALE, CAMERA)

    def __init__(
        self,
        altitude: Series,
        path: CameraPath,
        points_m: Array,  # [K, 3] of the map
        state: MetricState,
    ) -> None:
        """Keeps the samples whose beam meets the map at the body's pose in ``state``; the beam
        looks along the body's z. ``path`` covers all samples."""
        altitude = altitude.thin(MOST_BEAMS)
        turns = TURNED * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        mountings = [so3_exp(turn) @ state.R_bc for turn in turns]
        ranges = np.array(
            [
                _first_returns(points_m, *_beams(R_mc, p_m, mountings, state))
                for R_mc, p_m in zip(*path.at(altitude.t_s), strict=True)
            ]
        ).reshape(-1, len(mountings))
        met = np.isfinite(ranges).all(axis=1)
        ranges = ranges[met]
        self.source, self.t_s = altitude.source, altitude.t_s[met]
        self._range, self._altitude_m = ranges[:, 0], altitude.values[met, 0]
        slopes = (ranges[:, 1::2] - ranges[:, 2::2]) / (2.0 * TURNED)
        self._by_turn = np.column_stack([slopes, np.zeros(len(slopes))])
        self._R_bc = state.R_bc
        self.sigma = np.hypot(SIGMA_M, SHARE * self._altitude_m)

    @property
    def rough_log_scale(self) -> float:
        """Log scale of metres per map unit, from the median of the ratios."""
        return float(np.log(np.median(self._altitude_m / self._range)))

    def residuals(self, state: MetricState) -> Array:
        """[N, 1] m."""
        return np.asarray((state.scale * self._ranges(state) - self._altitude_m)[:, None])

    def scale_misfit(self, state: MetricState) -> tuple[Array, Array]:
        """Logarithm of the scale that each range alone gives, over the state's; 1 sigma."""
        ranges = state.scale * self._ranges(state)
        return -self.residuals(state)[:, 0] / ranges, self.sigma / ranges

    def _ranges(self, state: MetricState) -> Array:
        """[N] map units, with the mounting of ``state``: to first order."""
        return np.asarray(self._range + self._by_turn @ so3_log(state.R_bc @ self._R_bc.T))


def _beams(
    R_mc: Array,  # [3, 3]
    p_m: Array,  # [3]
    mountings: Sequence[Array],  # [3, 3] each, R_bc
    state: MetricState,
) -> tuple[Array, Array]:
    """Origins and directions [J, 3] of the beam in the map, for each mounting of the camera."""
    R_mb = np.stack([R_mc @ R_bc.T for R_bc in mountings])
    return p_m - R_mb @ state.c_b / state.scale, R_mb[:, :, 2]


def _first_returns(
    points: Array,  # [K, 3] map
    apexes: Array,  # [J, 3] map
    axes: Array,  # [J, 3] unit vectors, about parallel
) -> Array:
    """[J] ranges from each apex to the nearest points within its beam; NaN if it meets none."""
    points = _within(points, apexes[0], axes[0], HALF_BEAM + WIDER)[0]
    found = np.full(len(axes), np.nan)
    for j, (apex, axis) in enumerate(zip(apexes, axes, strict=True)):
        ranges = _within(points, apex, axis, HALF_BEAM)[1]
        if len(ranges) >= LEAST_POINTS:
            found[j] = np.percentile(ranges, FIRST_RETURN)
    return found


def _within(
    points: Array,  # [K, 3]
    apex: Array,  # [3]
    axis: Array,  # [3] unit vector
    half_angle: float,
) -> tuple[Array, Array]:
    """Points [n, 3] within a cone, and their ranges [n] from its apex."""
    away = points - apex
    along = away @ axis
    ahead = along > 0.0
    points, away, along = points[ahead], away[ahead], along[ahead]
    ranges = np.linalg.norm(away, axis=1)
    inside = along > np.cos(half_angle) * ranges
    return points[inside], ranges[inside]
