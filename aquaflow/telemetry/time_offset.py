"""A video and a log that were never synchronised: the offset between their clocks.

Both saw the same rotations. Every offset is searched, the best ones are refined, and the best of
all counts only if it explains the camera's rotations, and does so better than each of the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import stdtr

from aquaflow.base.errors import InputError
from aquaflow.telemetry.offset_refinement import (
    DRIFT,
    DRIFT_SIGMA,
    LOG_SCALE,
    OFFSET,
    OWN_INTERVALS,
    TURN,
    OffsetFit,
    Refinement,
)
from aquaflow.telemetry.offset_search import SHORTEST_OVERLAP_S, RateSeries, peak_at, peaks
from aquaflow.telemetry.turns import Turns, turns_of_telemetry
from aquaflow.types import TelemetrySample

Array = npt.NDArray[np.float64]

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
) -> TimeOffset:
    """The offset of a log, from the turns of a camera and of the vehicle that carries it.

    ``R_cb`` is the rotation from body to camera axes where it is known, to some degrees: it
    excludes offsets that need another. Either way it is found too. Of offsets that explain the
    rotations equally well, the one near ``expected_s`` counts, where one is expected.

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
    fits = [fit for peak in peaks(*cells, R_cb) if (fit := refinement.fit(peak)) is not None]
    if expected_s is not None:
        found = _as_expected(cells, R_cb, expected_s, refinement, fits, sigma_s)
        if found is not None:
            return found
    if not fits:
        raise UnlikeError("the log's rotations resemble the video's at no offset")
    best = max(fits, key=lambda fit: fit.gain)
    rivals = [fit for fit in fits if abs(fit.x[OFFSET] - best.x[OFFSET]) > sigma_s]
    return _judge(best, rivals, sigma_s)


def _as_expected(
    cells: tuple[RateSeries, RateSeries],
    R_cb: Array | None,  # [3, 3]
    expected_s: float,
    refinement: Refinement,
    fits: Sequence[OffsetFit],
    step_s: float,
) -> TimeOffset | None:
    """The offset near the expected one; None where it explains nothing, or another one more."""
    fit = refinement.fit(peak_at(*cells, R_cb, expected_s))
    if fit is None or abs(fit.x[OFFSET] - expected_s) > NEAR_EXPECTED_S:
        return None
    for rival in fits:
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
