"""A video and a log that were never synchronised: the offset between their clocks.

Both saw the same rotations. Every offset is searched, the best ones are refined, and the best of
all counts only if it explains the camera's rotations, and does so better than each of the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation
from scipy.special import stdtr

from aquaflow.base.errors import InputError
from aquaflow.optimise.least_squares import RobustFit, Rules, minimise
from aquaflow.optimise.robust import Huber
from aquaflow.telemetry.turns import (
    COVERED,
    SHORTEST_OVERLAP_S,
    OffsetPeak,
    RateSeries,
    Turns,
    explained_at_all_offsets,
    peak_at,
    peaks,
    smoothing,
    turns_of_telemetry,
)
from aquaflow.types import TelemetrySample

# --------------------------------------------------------------------------------------------------
# The offset to a fraction of a frame, with its covariance: a robust fit of one model.
#
# The camera's turn over each frame interval is the body's over the same interval, turned into
# camera axes. Both are smoothed alike, which keeps the band in which vehicles move and drops the
# noise of single poses.

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
ANY_DRIFT_SIGMA = 0.3
"""1 sigma of a clock's rate where no crystal limits it: a stream that falls behind ever more, or
pictures at another rate than is stated, 25 for 30 a second."""


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
        """Correlation of the rates seen and predicted, about their means: 1 is perfect."""
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

    def fit(self, peak: OffsetPeak, drift_sigma: float = DRIFT_SIGMA) -> OffsetFit | None:
        """The optimum near ``peak``; None where too little is measured there."""
        used = self._used_points(peak.offset_s)
        if 3 * used.sum() <= 2 * PARAMETERS:
            return None
        smooth = csr_array(self._smooth[np.flatnonzero(used)])
        at_s, seen = self.at_s[used], self._seen[used]
        middle_s = float(at_s.mean()) - peak.offset_s
        model = _Model(self._camera, self._body, smooth, at_s, seen, middle_s, peak.R_cb)
        start, sigmas = np.zeros(PARAMETERS), self._sigmas.copy()
        start[OFFSET], sigmas[DRIFT] = peak.offset_s, drift_sigma
        problem = _Turning(
            model.residuals, model.jacobian, Huber(), start, sigmas, least_noise=1e-9
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
        prior = np.diag(sigmas**-2.0)
        H = np.einsum("gip,gi,giq->pq", J, weight, J_seen) / sigma**2 + prior
        covariance = sandwich_of(J, weight * residual, H, prior, sigma, used, self._step_s)
        whole = np.zeros((len(used), 3))
        whole[used] = residual
        return OffsetFit(x, covariance, model.R_cb(x), middle_s, used, whole, self._seen)

    def fits(self, found: Sequence[OffsetPeak]) -> list[OffsetFit]:
        """The optima near some peaks; those near which too little is measured are left out."""
        return [fit for peak in found if (fit := self.fit(peak)) is not None]

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


Array = npt.NDArray[np.float64]


# --------------------------------------------------------------------------------------------------
# The offset between a video and a log.

SMOOTHING_S = 0.2
"""1 sigma of the Gaussian over which rates are compared. On 40 simulated dives of 20 and 60 s, with
a gyro and with attitudes, 0.15 to 0.3 s give the same errors; the stated sigma is true at 0.2."""
LEAST_MOTION_RAD_S = np.radians(0.2)
"""RMS rate below which a camera stands still: noise of 0.1 degree a pose, smoothed, is as much."""
LARGEST_SIGMA_S = 0.1
"""Beyond it the fit is no longer near its optimum, and an ROV has turned by a degree meanwhile."""
LARGEST_ROTATION_SIGMA_RAD = np.radians(8.0)
"""Of the rotation from body to camera. A vehicle that only yaws, and now and then, leaves the turn
about that axis open, and any of its yaws fits any other: of 60 simulated pairs of such dives, those
that belong together have 1 to 8 degrees, those that do not but fit, 8 to 34."""
BLOCK_S = 1.0
"""Pieces of the dive in which two explanations are compared."""
CHANCE_OF_NOTHING = 1e-4
"""Chance that an unrelated log explains this much, up to which the log counts as related: of 100
unrelated pairs of simulated random motion none passes, of as many related ones all."""
CHANCE_OF_RIVAL = 1e-3
"""Chance that another offset is as good, up to which it is not."""
CHANCE_AS_EXPECTED = 1e-3
"""As ``CHANCE_OF_NOTHING``, of the one offset that was expected: a search has hundreds of tries."""
NEAR_EXPECTED_S = 1.0
"""An offset that a fit finds from the expected one is still that: a quarter of an ROV's sway."""
RIVAL_LEAVES = 2.0
"""Times what the search leaves unexplained at the expected offset, beyond which another offset is
no rival: a fit would have to halve what is left there, and leave it at the expected one."""
KNOWN_DRIFT = 0.5
"""Share of the prior's sigma below which the overlap has shown the clock's rate."""


class NotSynchronisedError(InputError):
    """The offset between a video and a log cannot be found from their rotations."""


class UnlikeError(NotSynchronisedError):
    """Both turned, and unlike each other at every offset."""


@dataclass(frozen=True)
class TimeOffset:
    """Video time of a log: ``video = telemetry + offset_s + drift * (telemetry - middle_s)``."""

    offset_s: float
    sigma_s: float = 0.0
    """1 sigma of ``offset_s``."""
    drift: float = 0.0
    """How much faster the video's clock runs; 0 where the overlap is too short to know."""
    drift_sigma: float = DRIFT_SIGMA
    middle_s: float = 0.0
    """Telemetry time for which ``offset_s`` is stated: the middle of what was compared."""
    R_cb: Array | None = None
    """[3, 3] body to camera axes as the rotations show them; None where they were not compared."""
    rotation_sigma_rad: float = 0.0
    """1 sigma of ``R_cb`` about its least known axis; large where the vehicle turned about one
    axis only."""
    scale: float = 1.0
    """Turn seen over turn measured: away from 1 where the focal length is wrong."""
    correlation: float = 1.0
    """Of the rates seen and measured; 1 is perfect."""

    def video_ns(self, t_ns: int) -> int:
        """The video's time of a moment of the log, ns."""
        away_s = t_ns * 1e-9 - self.middle_s
        return t_ns + round(1e9 * (self.offset_s + self.drift * away_s))

    def sigma_at_s(self, t_s: float) -> float:
        """1 sigma of the video's time at a telemetry time."""
        return float(np.hypot(self.sigma_s, self.drift_sigma * (t_s - self.middle_s)))


def synchronise_samples(
    samples: Iterable[TelemetrySample], offset: TimeOffset
) -> list[TelemetrySample]:
    """The samples of a log on the video's clock: moment of measurement and of arrival."""
    return [
        replace(
            sample,
            t_ns=offset.video_ns(sample.t_ns),
            arrival_ns=offset.video_ns(sample.arrival_ns),
        )
        for sample in samples
    ]


def estimate_time_offset(
    camera: Turns,
    body: Turns,
    R_cb: Array | None = None,  # [3, 3]
    expected_s: float | None = None,
    any_drift: bool = False,
) -> TimeOffset:
    """The offset of a log, from the turns of a camera and of the vehicle that carries it.

    ``R_cb`` is the rotation from body to camera axes where it is known, to some degrees: it
    excludes offsets that need another. Either way it is found too. Of offsets that explain the
    rotations equally well, the one near ``expected_s`` counts, where one is expected. With
    ``any_drift`` the drift about it is what the rotations show, however large; without, no more
    than crystals have.

    Raises:
        NotSynchronisedError: too little was measured or moved, nothing correlates
            (:class:`UnlikeError`), or several offsets are as good.
    """
    for turns, whose in ((camera, "the video's poses"), (body, "the log's rotations")):
        if turns.covered_s < SHORTEST_OVERLAP_S:
            raise NotSynchronisedError(
                f"{whose} cover {turns.covered_s:.1f} s, and {SHORTEST_OVERLAP_S:.0f} s are needed"
            )
    intervals = [float(np.median(turns.end_s - turns.start_s)) for turns in (camera, body)]
    sigma_s = max(SMOOTHING_S, intervals[0], 1.5 * OWN_INTERVALS * intervals[1])
    cells = RateSeries.of(camera, sigma_s), RateSeries.of(body, sigma_s)
    for cell, whose in zip(cells, ("camera", "vehicle"), strict=True):
        if _rms(cell) < LEAST_MOTION_RAD_S:
            raise NotSynchronisedError(
                f"the {whose} hardly turned ({np.degrees(_rms(cell)):.2f} degrees/s), so that its "
                "rotations do not show the time"
            )
    refinement = Refinement(camera, body, sigma_s, mounting_known=R_cb is not None)
    searched, found = explained_at_all_offsets(*cells, R_cb), None
    tried = peaks(searched, R_cb)
    if expected_s is not None:
        near = peak_at(searched, R_cb, expected_s)
        found = _as_expected(near, refinement, tried, sigma_s)
    if found is None:
        fits = refinement.fits(tried)
        if not fits:
            raise UnlikeError("the log's rotations resemble the video's at no offset")
        best = max(fits, key=lambda fit: fit.gain)
        rivals = [fit for fit in fits if abs(fit.x[OFFSET] - best.x[OFFSET]) > sigma_s]
        found = _judge(best, rivals, sigma_s)
    return _with_any_drift(found, refinement, R_cb) if any_drift else found


def _with_any_drift(
    found: TimeOffset,
    refinement: Refinement,
    R_cb: Array | None,  # [3, 3]
) -> TimeOffset:
    """The offset with the drift that the rotations show about it."""
    R_start = found.R_cb if R_cb is None else R_cb
    assert R_start is not None
    fit = refinement.fit(OffsetPeak(found.offset_s, R_start, 1.0), ANY_DRIFT_SIGMA)
    if fit is None:
        return replace(found, drift=0.0, drift_sigma=ANY_DRIFT_SIGMA)
    sigma = float(np.hypot(DRIFT_SIGMA, np.sqrt(fit.covariance[DRIFT, DRIFT])))
    return replace(found, drift=float(fit.x[DRIFT]), drift_sigma=sigma)


def _as_expected(
    expected: OffsetPeak, refinement: Refinement, rivals: Sequence[OffsetPeak], step_s: float
) -> TimeOffset | None:
    """The offset near the expected one; None where it explains nothing, or another one more."""
    fit = refinement.fit(expected)
    if fit is None or abs(fit.x[OFFSET] - expected.offset_s) > NEAR_EXPECTED_S:
        return None
    most = RIVAL_LEAVES * (1.0 - expected.explained)
    others = [each for each in rivals if abs(each.offset_s - fit.x[OFFSET]) > step_s]
    for rival in refinement.fits([each for each in others if 1.0 - each.explained <= most]):
        both = fit.used & rival.used
        if rival.gain > fit.gain and _chance(fit.residual, rival, both, step_s) < CHANCE_OF_RIVAL:
            return None
    try:
        return _judge(fit, [], step_s, CHANCE_AS_EXPECTED)
    except NotSynchronisedError:
        return None


def _judge(
    best: OffsetFit, rivals: list[OffsetFit], step_s: float, chance: float = CHANCE_OF_NOTHING
) -> TimeOffset:
    """The best fit as a result.

    Raises:
        NotSynchronisedError: it is not significant, not the only one, or not sharp.
    """
    if _chance(_unexplained_rates(best), best, best.used, step_s) > chance:
        raise UnlikeError(
            f"the log's rotations do not explain the video's (correlation {best.correlation:.2f} "
            f"at the best offset, {best.x[OFFSET]:+.1f} s)"
        )
    for rival in rivals:
        both = best.used & rival.used
        if _chance(rival.residual, best, both, step_s) > CHANCE_OF_RIVAL:
            raise NotSynchronisedError(
                f"offsets of {best.x[OFFSET]:+.1f} s and {rival.x[OFFSET]:+.1f} s explain the "
                "video's rotations equally well"
            )
    sigma_s = float(np.sqrt(best.covariance[OFFSET, OFFSET]))
    if not sigma_s <= LARGEST_SIGMA_S:
        raise NotSynchronisedError(
            f"the rotations show the offset of {best.x[OFFSET]:+.1f} s to {sigma_s:.2f} s only"
        )
    rotation_sigma_rad = float(np.sqrt(np.linalg.eigvalsh(best.covariance[TURN, TURN])[-1]))
    if not rotation_sigma_rad <= LARGEST_ROTATION_SIGMA_RAD:
        raise NotSynchronisedError(
            f"at the best offset, {best.x[OFFSET]:+.1f} s, little but a single axis turned, and "
            "such turns resemble each other; state how the camera is mounted (fusion.camera)"
        )
    drift_sigma = float(np.sqrt(best.covariance[DRIFT, DRIFT]))
    return TimeOffset(
        offset_s=float(best.x[OFFSET]),
        sigma_s=sigma_s,
        drift=float(best.x[DRIFT]) if drift_sigma < KNOWN_DRIFT * DRIFT_SIGMA else 0.0,
        drift_sigma=drift_sigma if drift_sigma < KNOWN_DRIFT * DRIFT_SIGMA else DRIFT_SIGMA,
        middle_s=best.middle_s,
        R_cb=best.R_cb,
        rotation_sigma_rad=rotation_sigma_rad,
        scale=float(np.exp(best.x[LOG_SCALE])),
        correlation=best.correlation,
    )


def _rms(cells: RateSeries) -> float:
    """Of the rates about their mean, rad/s."""
    rates = cells.rate_rad_s[cells.measured > 0.0]
    return (
        float(np.sqrt(((rates - rates.mean(axis=0)) ** 2).sum(axis=1).mean()))
        if len(rates)
        else 0.0
    )


def _unexplained_rates(fit: OffsetFit) -> Array:
    """[G, 3] what is left of the camera's rates if the telemetry explains nothing."""
    return np.asarray(fit.seen - fit.seen[fit.used].mean(axis=0))


def _chance(
    other: Array,  # [G, 3] rad/s
    best: OffsetFit,
    where: npt.NDArray[np.bool_],  # [G]
    step_s: float,
) -> float:
    """Chance that residuals ``other`` are no larger than those of ``best``, by a paired t-test.

    Logarithms of the squares of each block are compared: so one strong turn, which fits any other
    of its shape, is one piece of evidence among many.
    """
    block = np.flatnonzero(where) // max(1, round(BLOCK_S / step_s))
    counts = np.bincount(block)
    full = counts >= 0.5 * counts.max(initial=1)
    if full.sum() < 3:
        return 1.0
    energies = [
        np.bincount(block, (residual[where] ** 2).sum(axis=1))[full] + np.finfo(float).tiny
        for residual in (other, best.residual)
    ]
    gain = np.log(energies[0]) - np.log(energies[1])
    with np.errstate(divide="ignore", invalid="ignore"):  # all gains the same, or nothing
        t = gain.mean() / (gain.std(ddof=1) / np.sqrt(len(gain)))
    return float(stdtr(len(gain) - 1, -t))


def offset_of_log(
    name: str,
    samples: Iterable[TelemetrySample],
    camera: Turns,
    R_cb: Array | None = None,  # [3, 3]
) -> TimeOffset:
    """The offset of the log ``name`` from its best source of rotations.

    Raises:
        NotSynchronisedError: as :func:`estimate_time_offset`, or the log holds no rotations.
    """
    found = turns_of_telemetry(samples)
    if found is None:
        reason = "the log holds neither angular rates nor attitudes"
    else:
        try:
            return estimate_time_offset(camera, found[1], R_cb)
        except NotSynchronisedError as error:
            reason = str(error)
    raise NotSynchronisedError(
        f"{name} could not be synchronised with the video: {reason}; give --telemetry-offset, "
        "if you know when the log began"
    )
