"""The offset to a fraction of a frame, with its covariance: a robust fit of one model.

The camera's turn over each frame interval is the body's over the same interval, turned into camera
axes. Both are smoothed alike, which keeps the band in which vehicles move and drops the noise of
single poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from aquaflow.geometry.robust import MAD_TO_SIGMA
from aquaflow.telemetry.offset_search import COVERED, OffsetPeak, RateSeries
from aquaflow.telemetry.turns import Turns, smoothing

Array: TypeAlias = npt.NDArray[np.float64]
Mask: TypeAlias = npt.NDArray[np.bool_]

DRIFT_SIGMA = 5e-5
"""1 sigma of a clock's rate before anything is known: crystals are sold at 20 to 50 ppm."""
BIAS_SIGMA_RAD_S = 0.02
"""1 sigma of a gyro's bias: MEMS data sheets give 0.5 to 1 degree/s before calibration."""
LOG_SCALE_SIGMA = 0.1
"""1 sigma of the turn seen over the turn measured: a guessed focal length is off by as much."""
MOUNTING_SIGMA_RAD = np.radians(5.0)
"""1 sigma of a mounting that was given: set by eye, on a bracket."""
FREE_SIGMA = 1e3
"""1 sigma of what nothing is known about, in s and rad."""

OFFSET, DRIFT, TURN, BIAS, LOG_SCALE = 0, 1, slice(2, 5), slice(5, 8), 8
PARAMETERS = 9

OWN_INTERVALS = 1.0
"""Smoothing of the body's turns, in intervals of its log, before they are interpolated: the noise
of interpolated samples depends on where between two of them one looks, and draws the offset."""
HUBER = 1.345
"""Residuals beyond so many sigma count linearly: 95 % efficient where the noise is Gaussian."""
ITERATIONS = 12
"""Of Gauss-Newton; the search starts it within 0.025 s, where 5 are enough."""
DERIVATIVE_S = 0.01
"""Half the step of the derivative with respect to time: below the interval of any gyro's log."""
LONGEST_CORRELATION_S = 2.0
"""Up to this lag the residuals' own autocorrelation enters the covariance."""


@dataclass(frozen=True)
class OffsetFit:
    """The model at its optimum."""

    x: Array
    """[9] offset (s) at ``middle_s``, drift, turn away from the peak's R_cb (rad), bias (rad/s),
    log-scale."""
    covariance: Array
    """[9, 9]"""
    R_cb: Array
    """[3, 3] body to camera."""
    middle_s: float
    """Telemetry time at which the offset is that of ``x``."""
    used: Mask
    """[G] points of the grid at which both were measured."""
    residual: Array
    """[G, 3] rad/s, seen less predicted."""
    seen: Array
    """[G, 3] rad/s, camera axes."""

    @property
    def gain(self) -> float:
        """Twice the logarithm of the likelihood ratio to no explanation, per axis: it counts how
        much is explained and how well, so that fits of different overlaps can be compared."""
        seen, left = self.seen[self.used], self.residual[self.used]
        total = float(((seen - seen.mean(axis=0)) ** 2).sum())
        return len(seen) * float(np.log(total / max(float((left**2).sum()), 1e-300)))

    @property
    def correlation(self) -> float:
        """Of the rates seen and predicted, about their means: 1 is perfect."""
        seen = self.seen[self.used]
        predicted = seen - self.residual[self.used]
        a, b = (values - values.mean(axis=0) for values in (seen, predicted))
        return float((a * b).sum() / max(np.sqrt((a**2).sum() * (b**2).sum()), 1e-300))


class Refinement:
    """The camera's turns, smoothed once, against the body's at any offset."""

    def __init__(self, camera: Turns, body: Turns, sigma_s: float, mounting_known: bool) -> None:
        self.at_s = np.arange(camera.start_s[0], camera.end_s[-1], sigma_s)
        self._step_s = sigma_s
        own_s = OWN_INTERVALS * float(np.median(body.end_s - body.start_s))
        smooth_camera, self._covered = smoothing(camera, self.at_s, sigma_s)
        self._seen = smooth_camera @ camera.angle_rad
        later, earlier = (
            smoothing(camera, self.at_s + sign * DERIVATIVE_S, sigma_s)[0] @ camera.angle_rad
            for sign in (1.0, -1.0)
        )
        self._change = (later - earlier) / (2.0 * DERIVATIVE_S)
        self._smooth, _ = smoothing(camera, self.at_s, np.sqrt(sigma_s**2 - own_s**2))
        self._camera, self._body = camera, RateSeries.of(body, own_s, 0.5 * own_s).turns()
        turn = MOUNTING_SIGMA_RAD if mounting_known else FREE_SIGMA
        sigmas = [FREE_SIGMA, DRIFT_SIGMA, *[turn] * 3, *[BIAS_SIGMA_RAD_S] * 3, LOG_SCALE_SIGMA]
        self._prior = np.diag(1.0 / np.square(sigmas))

    def fit(self, peak: OffsetPeak) -> OffsetFit | None:
        """The optimum near ``peak``; None where too little is measured there."""
        used = self._used_points(peak.offset_s)
        if 3 * used.sum() <= 2 * PARAMETERS:
            return None
        smooth = csr_array(self._smooth[np.flatnonzero(used)])
        at_s, seen = self.at_s[used], self._seen[used]
        middle_s = float(at_s.mean()) - peak.offset_s
        x, R_cb = np.zeros(PARAMETERS), peak.R_cb
        x[OFFSET] = peak.offset_s
        for _ in range(ITERATIONS):
            residual, J = self._linearise(x, R_cb, middle_s, smooth, at_s, seen)
            sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), 1e-9)
            weight = np.minimum(1.0, HUBER * sigma / np.maximum(np.abs(residual), 1e-12))
            H = np.einsum("gip,gi,giq->pq", J, weight, J) / sigma**2 + self._prior
            pull = np.einsum("gip,gi->p", J, weight * residual) / sigma**2
            expected = np.zeros(PARAMETERS)
            expected[OFFSET] = peak.offset_s
            step = np.linalg.solve(H, pull - self._prior @ (x - expected))
            R_cb = Rotation.from_rotvec(step[TURN]).as_matrix() @ R_cb
            x = x + step
            x[TURN] = Rotation.from_matrix(R_cb @ peak.R_cb.T).as_rotvec()
        J_seen = J.copy()
        J_seen[:, :, OFFSET] = -self._change[used]
        J_seen[:, :, DRIFT] = J_seen[:, :, OFFSET] * (at_s - x[OFFSET] - middle_s)[:, None]
        H = np.einsum("gip,gi,giq->pq", J, weight, J_seen) / sigma**2 + self._prior
        covariance = covariance_of(J, weight * residual, H, self._prior, sigma, used, self._step_s)
        whole = np.zeros((len(used), 3))
        whole[used] = residual
        return OffsetFit(x, covariance, R_cb, middle_s, used, whole, self._seen)

    def _used_points(self, offset_s: float) -> Mask:
        """[G] grid points whose surroundings were measured by both."""
        start_s, end_s = self._camera.start_s - offset_s, self._camera.end_s - offset_s
        _, covered = self._body.within(start_s, end_s)
        length = self._camera.end_s - self._camera.start_s
        both = self._smooth @ (length * (covered >= 1.0 - 1e-6))
        return np.asarray((both >= 1.0 - 1e-6) & (self._covered >= COVERED))

    def _linearise(
        self,
        x: Array,  # [9]
        R_cb: Array,  # [3, 3]
        middle_s: float,
        smooth: csr_array,
        at_s: Array,  # [U]
        seen: Array,  # [U, 3]
    ) -> tuple[Array, Array]:
        """Residual [U, 3] rad/s and the derivative [U, 3, 9] of the prediction."""

        def body_rate(offset_s: float) -> Array:
            edges = (
                middle_s + (t - offset_s - middle_s) / (1.0 + x[DRIFT])
                for t in (self._camera.start_s, self._camera.end_s)
            )
            return np.asarray(smooth @ self._body.within(*edges)[0])

        M = np.exp(x[LOG_SCALE]) * R_cb
        predicted = (body_rate(x[OFFSET]) - x[BIAS]) @ M.T
        later = body_rate(x[OFFSET] + DERIVATIVE_S)
        earlier = body_rate(x[OFFSET] - DERIVATIVE_S)
        J = np.empty((len(seen), 3, PARAMETERS))
        J[:, :, OFFSET] = (later - earlier) @ M.T / (2.0 * DERIVATIVE_S)
        J[:, :, DRIFT] = J[:, :, OFFSET] * (at_s - x[OFFSET] - middle_s)[:, None]
        J[:, :, TURN] = np.cross(np.eye(3), predicted[:, None, :]).transpose(0, 2, 1)
        J[:, :, BIAS] = -M
        J[:, :, LOG_SCALE] = predicted
        return seen - predicted, J


def covariance_of(
    J: Array,  # [U, 3, P]
    score: Array,  # [U, 3] weighted residuals, rad/s
    H: Array,  # [P, P]
    prior: Array,  # [P, P]
    sigma: float,
    used: Mask,  # [G]
    step_s: float,
) -> Array:
    """[P, P] covariance with the residuals' own autocorrelation (Newey and West, 1987).

    The autocovariance is that of all three axes together: a short clip has few residuals.
    """
    points = len(used)
    values, derivative = np.zeros((points, 3)), np.zeros((points, 3, J.shape[2]))
    values[used], derivative[used] = score, J
    lags = min(round(LONGEST_CORRELATION_S / step_s), max(int(used.sum()) // 4, 1))
    meat = np.zeros_like(H)
    independent = 1.0
    variance = float((score**2).mean())
    for lag in range(lags):
        pairs = 3 * int((used[lag:] & used[: points - lag]).sum())
        product = float((values[lag:] * values[: points - lag]).sum()) / max(pairs, 1)
        product *= 1.0 - lag / lags
        between = np.einsum("gip,giq->pq", derivative[lag:], derivative[: points - lag])
        meat += product * (between if lag == 0 else between + between.T)
        independent += 2.0 * (product / max(variance, 1e-300)) ** 2 if lag else 0.0
    freedom = score.size / independent
    inflation = freedom / max(freedom - J.shape[2], 1.0)
    inverse = np.linalg.inv(H)
    return np.asarray(inverse @ (inflation * meat / sigma**4 + prior) @ inverse.T)
