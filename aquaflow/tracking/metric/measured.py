"""What each source of telemetry says about single keyframes, given the estimator's frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.telemetry.estimator import Estimate
from aquaflow.telemetry.factors import (
    AltitudeFactor,
    DepthFactor,
    Factor,
    HeadingFactor,
    PositionFactor,
    TiltFactor,
    VelocityFactor,
)
from aquaflow.telemetry.state import MetricState
from aquaflow.tracking.metric.world_edges import KeyframeMeasurements, WorldEdge, world_edge

Array = npt.NDArray[np.float64]
Wanted = Callable[[Factor, MetricState], tuple[Array, Array]]

NEAR_S = 0.5
"""s; a measurement belongs to keyframes no further away in time. What it adds is the difference to
the camera's own path at its own moment, which hardly changes in so short a time."""
DIRECTION_TIME_S = 60.0
"""s, correlation time of the errors of attitude filters and compasses."""
HELD = 1e-3
"""m and rad, 1 sigma of what is a convention: where the world's origin and its x axis are."""
LARGEST_SCALE_SIGMA = 0.2
"""Relative; what says less of the scale is left out: a vehicle that hovers."""


@dataclass(frozen=True)
class Corrections:
    """What one kind of source wants changed along the dive, with the noise of its data sheet.

    The estimator's own noise does not serve here: what the camera's path errs counts as noise
    there, and is what shall be corrected here.
    """

    t_s: Array
    """[N] s"""
    wanted: Array
    """[N, D]"""
    sigma: Array
    """[N] white, 1 sigma of each component."""
    slow: float
    """1 sigma of what the samples near a keyframe have in common."""

    def at(self, t_s: float) -> tuple[Array, float] | None:
        """Mean [D] of those near a moment, and its 1 sigma; None where none is near."""
        low, high = np.searchsorted(self.t_s, (t_s - NEAR_S, t_s + NEAR_S))
        if high <= low:
            return None
        weight = self.sigma[low:high] ** -2.0
        mean = (weight[:, None] * self.wanted[low:high]).sum(axis=0) / weight.sum()
        return mean, float(np.hypot(1.0 / np.sqrt(weight.sum()), self.slow))


def world_edges(
    estimate: Estimate,
    numbers: npt.NDArray[np.int64],  # [K] keyframes
    t_s: Array,  # [K] s
    T_mk: Sim3Batch,  # [K]
) -> list[WorldEdge]:
    """Edges from the world to keyframes of one sub-map, where telemetry measured something."""
    if not estimate.frame.level:
        return []
    spacing = float(np.ptp(t_s)) / max(len(t_s) - 1, 1)
    # Errors that last longer than keyframes are apart: as much information as there is in them.
    repeated = np.sqrt(1.0 + 2.0 * DIRECTION_TIME_S / max(spacing, 1e-3))
    tilt = _of(estimate, TiltFactor, _turn, repeated)
    north = _of(estimate, HeadingFactor, lambda f, at: (-f.residuals(at), f.sigma), repeated)
    depth = place = scale = None
    if estimate.frame.metric:
        depth = _of(estimate, DepthFactor, lambda f, at: (-f.residuals(at), f.sigma))
        place = _of(estimate, PositionFactor, lambda f, at: (-f.residuals(at), f.sigma))
        scale = _of(estimate, VelocityFactor, _scale) or _of(estimate, AltitudeFactor, _scale)
    found = []
    for i, number in enumerate(numbers.tolist()):
        T_nk, t = estimate.frame.T_nm @ T_mk.element(i), float(t_s[i])
        measured = _measure(T_nk, t, depth, place, scale, tilt, north)
        if i == 0:
            measured = _hold(measured, T_nk, place is None, depth is None, north is None)
        edge = world_edge(number, T_nk, measured)
        if edge is not None:
            found.append(edge)
    return found


def _measure(
    T_nk: Sim3,
    t_s: float,
    depth: Corrections | None,
    place: Corrections | None,
    scale: Corrections | None,
    tilt: Corrections | None,
    north: Corrections | None,
) -> KeyframeMeasurements:
    deeper, moved, larger = _near(depth, t_s), _near(place, t_s), _near(scale, t_s)
    turned, swung = _near(tilt, t_s), _near(north, t_s)
    measured = KeyframeMeasurements()
    if deeper is not None:
        measured = replace(measured, depth_m=(float(T_nk.t[2] + deeper[0][0]), deeper[1]))
    if moved is not None:
        measured = replace(measured, place_m=(T_nk.t[:2] + moved[0], moved[1]))
    if larger is not None:
        measured = replace(measured, scale=(T_nk.scale * float(np.exp(larger[0][0])), larger[1]))
    if turned is not None:
        turn, sigma, north_sigma = turned[0].copy(), turned[1], np.inf
        if swung is not None:
            turn[2], north_sigma = swung[0][0], swung[1]
        measured = replace(measured, turn=turn, turn_sigma=(sigma, north_sigma))
    return measured


def _hold(
    measured: KeyframeMeasurements, T_nk: Sim3, place: bool, depth: bool, north: bool
) -> KeyframeMeasurements:
    """What nothing measures anywhere is held at the first keyframe, or the world would drift."""
    if place:
        measured = replace(measured, place_m=(T_nk.t[:2].copy(), HELD))
    if depth:
        measured = replace(measured, depth_m=(float(T_nk.t[2]), HELD))
    if north:
        tilt_sigma = measured.turn_sigma[0] if measured.turn is not None else np.inf
        turn = np.zeros(3) if measured.turn is None else measured.turn
        measured = replace(measured, turn=turn, turn_sigma=(tilt_sigma, HELD))
    return measured


def _near(corrections: Corrections | None, t_s: float) -> tuple[Array, float] | None:
    return None if corrections is None else corrections.at(t_s)


def _of(
    estimate: Estimate, kind: type[Factor], wanted: Wanted, repeated: float = 1.0
) -> Corrections | None:
    """The corrections of the first factor of a kind; None if there is none."""
    assert estimate.problem is not None
    assert estimate.solution is not None
    state = estimate.solution.state
    for factor, kept in zip(estimate.problem.factors, estimate.solution.kept, strict=True):
        if type(factor) is kind and kept.any():
            values, sigma = wanted(factor, state)
            slow = repeated * (
                0.0 if kind in (VelocityFactor, AltitudeFactor) else factor.slow.least
            )
            chosen = kept & (sigma <= LARGEST_SCALE_SIGMA) if slow == 0.0 else kept
            return Corrections(factor.t_s[chosen], values[chosen], sigma[chosen], slow)
    return None


def _turn(factor: Factor, state: MetricState) -> tuple[Array, Array]:
    assert isinstance(factor, TiltFactor)
    return factor.turn_wanted(state), factor.sigma


def _scale(factor: Factor, state: MetricState) -> tuple[Array, Array]:
    assert isinstance(factor, (VelocityFactor, AltitudeFactor))
    misfit, sigma = factor.scale_misfit(state)
    return misfit[:, None], sigma
