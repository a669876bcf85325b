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

from aquaflow.optimise.least_squares import RobustFit, Rules, minimise
from aquaflow.optimise.robust import Huber
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
RULES = Rules(iterations=12, sigmas=1e-3, damping=0.0)
"""Of the fit; the search starts it within 0.025 s, where 5 iterations are enough."""
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
        self._sigmas = np.array(
            [FREE_SIGMA, DRIFT_SIGMA, *[turn] * 3, *[BIAS_SIGMA_RAD_S] * 3, LOG_SCALE_SIGMA]
        )

    def fit(self, peak: OffsetPeak) -> OffsetFit | None:
        """The optimum near ``peak``; None where too little is measured there."""
        used = self._used_points(peak.offset_s)
        if 3 * used.sum() <= 2 * PARAMETERS:
            return None
        smooth = csr_array(self._smooth[np.flatnonzero(used)])
        at_s, seen = self.at_s[used], self._seen[used]
        middle_s = float(at_s.mean()) - peak.offset_s
        model = _Model(self._camera, self._body, smooth, at_s, seen, middle_s, peak.R_cb)
        start = np.zeros(PARAMETERS)
        start[OFFSET] = peak.offset_s
        problem = _Turning(
            model.residuals, model.jacobian, Huber(), start, self._sigmas, least_noise=1e-9
        )
        x = minimise(problem, start, RULES).state
        problem.linearise(x)
        sigma = problem.noise
        residual = -model.residuals(x).reshape(-1, 3)
        J = model.jacobian(x).reshape(-1, 3, PARAMETERS)
        weight = problem.kernel.weight(np.abs(residual) / sigma)
        J_seen = J.copy()
        J_seen[:, :, OFFSET] = -self._change[used]
        J_seen[:, :, DRIFT] = J_seen[:, :, OFFSET] * (at_s - x[OFFSET] - middle_s)[:, None]
        prior = np.diag(self._sigmas**-2.0)
        H = np.einsum("gip,gi,giq->pq", J, weight, J_seen) / sigma**2 + prior
        covariance = sandwich_of(J, weight * residual, H, prior, sigma, used, self._step_s)
        whole = np.zeros((len(used), 3))
        whole[used] = residual
        return OffsetFit(x, covariance, model.R_cb(x), middle_s, used, whole, self._seen)

    def _used_points(self, offset_s: float) -> Mask:
        """[G] grid points whose surroundings were measured by both."""
        start_s, end_s = self._camera.start_s - offset_s, self._camera.end_s - offset_s
        _, covered = self._body.within(start_s, end_s)
        length = self._camera.end_s - self._camera.start_s
        both = self._smooth @ (length * (covered >= 1.0 - 1e-6))
        return np.asarray((both >= 1.0 - 1e-6) & (self._covered >= COVERED))


@dataclass(frozen=True)
class _Model:
    """The camera's rates as the body's predict them, about one peak of the search."""

    camera: Turns
    body: Turns
    smooth: csr_array
    """[U, intervals of the camera]"""
    at_s: Array
    """[U] points of the grid at which both were measured."""
    seen: Array
    """[U, 3] rad/s"""
    middle_s: float
    R_start: Array
    """[3, 3] body to camera, from which the turn of ``x`` counts."""

    def R_cb(
        self,
        x: Array,  # [9]
    ) -> Array:
        """[3, 3] body to camera."""
        return np.asarray(Rotation.from_rotvec(x[TURN]).as_matrix() @ self.R_start)

    def residuals(
        self,
        x: Array,  # [9]
    ) -> Array:
        """[3 U] rad/s, predicted less seen."""
        return (self._predict(x) - self.seen).ravel()

    def jacobian(
        self,
        x: Array,  # [9]
    ) -> Array:
        """[3 U, 9]"""
        M, predicted = np.exp(x[LOG_SCALE]) * self.R_cb(x), self._predict(x)
        later, earlier = (self._body_rate(x, sign * DERIVATIVE_S) for sign in (1.0, -1.0))
        J = np.empty((len(self.seen), 3, PARAMETERS))
        J[:, :, OFFSET] = (later - earlier) @ M.T / (2.0 * DERIVATIVE_S)
        J[:, :, DRIFT] = J[:, :, OFFSET] * (self.at_s - x[OFFSET] - self.middle_s)[:, None]
        J[:, :, TURN] = np.cross(np.eye(3), predicted[:, None, :]).transpose(0, 2, 1)
        J[:, :, BIAS] = -M
        J[:, :, LOG_SCALE] = predicted
        return J.reshape(-1, PARAMETERS)

    def _predict(
        self,
        x: Array,  # [9]
    ) -> Array:
        """[U, 3] rad/s in camera axes."""
        M = np.exp(x[LOG_SCALE]) * self.R_cb(x)
        return np.asarray((self._body_rate(x) - x[BIAS]) @ M.T)

    def _body_rate(
        self,
        x: Array,  # [9]
        later_s: float = 0.0,
    ) -> Array:
        """[U, 3] rad/s in body axes, with the offset moved by ``later_s``."""
        edges = (
            self.middle_s + (t - x[OFFSET] - later_s - self.middle_s) / (1.0 + x[DRIFT])
            for t in (self.camera.start_s, self.camera.end_s)
        )
        return np.asarray(self.smooth @ self.body.within(*edges)[0])


class _Turning(RobustFit):
    """With a turn among the numbers, which steps from the left."""

    def move(
        self,
        x: Array,  # [P]
        step: Array,  # [P]
    ) -> Array:
        """x [9] moved by a step [9]."""
        moved = x + step
        turned = Rotation.from_rotvec(step[TURN]) * Rotation.from_rotvec(x[TURN])
        moved[TURN] = turned.as_rotvec()
        return moved


def sandwich_of(
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
