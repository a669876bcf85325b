"""What telemetry says about single keyframes, given the estimator's frame: edges of the graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3, Sim3Batch, so3_exp
from aquaflow.telemetry.altimeter import AltitudeFactor
from aquaflow.telemetry.estimator import Estimate
from aquaflow.telemetry.factors import (
    DepthFactor,
    Factor,
    HeadingFactor,
    PositionFactor,
    TiltFactor,
    VelocityFactor,
)
from aquaflow.telemetry.state import MetricState
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]
Wanted = Callable[[Factor, MetricState], tuple[Array, Array]]

NEAR_S = 0.5
"""s; a measurement belongs to keyframes no further away in time. What it adds is the difference to
the camera's own path at its own moment, which hardly changes in so short a time."""
DIRECTION_TIME_S = 60.0
"""s, correlation time of the errors of attitude filters and compasses."""
HELD = 1e-3
"""m and rad, 1 sigma of what is a convention: where the world's origin and its x axis are."""
LEAST_FOR_TREND = 8
"""Keyframes with a measured scale below which a trend is not looked for."""
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


# --------------------------------------------------------------------------------------------------
# Telemetry as edges of the keyframe graph: from the world to single keyframes.
#
# The world n becomes a node of its own, whose pose T_mn the optimisation finds with the keyframes'.
# Its edge to a keyframe says what telemetry measured there: the depth, where down and north are,
# the scale that a DVL's displacement gives, a fix. In all other directions it has no information,
# and there the measured pose is the present one. So scale drift along a dive is pulled straight by
# the same solver that closes loops (Eq. 4), and no other equation is needed.


@dataclass(frozen=True)
class KeyframeMeasurements:
    """What telemetry says of one keyframe; None where it says nothing."""

    depth_m: tuple[float, float] | None = None
    """z of the camera in n, and 1 sigma."""
    turn: Array | None = None
    """[3] rad, from the present orientation to the measured one, in the axes of n."""
    turn_sigma: tuple[float, float] = (0.0, 0.0)
    """1 sigma of down and of north, rad; infinite for a north that is not measured."""
    scale: tuple[float, float] | None = None
    """Metres per unit of the keyframe, and relative 1 sigma."""
    place_m: tuple[Array, float] | None = None
    """[2] north and east of the camera in n, and 1 sigma of each."""


@dataclass(frozen=True)
class WorldEdge:
    """The measured pose of a keyframe in n, with information only where something was measured."""

    keyframe: int
    T_nk: Sim3
    information: Array
    """[7, 7] of the right tangent of ``T_nk``."""
    chi2: float
    """Squared difference to the present pose, in sigmas."""
    count: int
    """Numbers that were measured."""
    scale_apart: tuple[float, float] | None = None
    """Logarithm of the measured over the present scale, and 1 sigma; None where not measured."""


def world_edge(
    keyframe: int,
    T_nk: Sim3,
    measured: KeyframeMeasurements,
) -> WorldEdge | None:
    """The edge to a keyframe that is at ``T_nk`` now; None if nothing was measured.

    A step d = [u, w, q] of the keyframe, T exp(d), moves its place by scale R u, turns it by R w
    in the axes of n, and changes the logarithm of its scale by q.
    """
    t, R, scale = T_nk.t.copy(), T_nk.R, T_nk.scale
    rows: list[Array] = []
    if measured.depth_m is not None:
        t[2], sigma = measured.depth_m
        rows.append(_moves(2, T_nk) / sigma)
    if measured.place_m is not None:
        t[:2], sigma = measured.place_m
        rows += [_moves(axis, T_nk) / sigma for axis in (0, 1)]
    if measured.turn is not None:
        sigmas = (measured.turn_sigma[0], measured.turn_sigma[0], measured.turn_sigma[1])
        known = np.isfinite(sigmas)
        R = so3_exp(np.where(known, measured.turn, 0.0)) @ R
        rows += [_turns(axis, T_nk) / sigmas[axis] for axis in range(3) if known[axis]]
    scale_apart = None
    if measured.scale is not None:
        scale, sigma = measured.scale
        scale_apart = float(np.log(scale / T_nk.scale)), sigma
        rows.append(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0 / sigma]))
    if not rows:
        return None
    A, T_measured = np.stack(rows), Sim3(R, t, scale)
    apart = A @ (T_measured.inverse() @ T_nk).log()
    chi2 = float(apart @ apart)
    return WorldEdge(keyframe, T_measured, A.T @ A, chi2, len(rows), scale_apart)


def _moves(axis: int, T_nk: Sim3) -> Array:
    """[7] how a step moves the keyframe along an axis of n."""
    return np.concatenate([T_nk.scale * T_nk.R[axis], np.zeros(4)])


def _turns(axis: int, T_nk: Sim3) -> Array:
    """[7] how a step turns the keyframe about an axis of n."""
    return np.concatenate([np.zeros(3), T_nk.R[axis], np.zeros(1)])


@dataclass(frozen=True)
class World:
    """The world of one component of the graph, and its edges."""

    component: int
    T_mn: Sim3
    edges: Sequence[WorldEdge]
    of_base: bool = False
    """True for the world of an earlier dive, beside that of telemetry."""

    @property
    def number(self) -> int:
        """Number of its node: negative, and no other's."""
        return -2 - 2 * self.component if self.of_base else -1 - 2 * self.component

    @property
    def strain(self) -> float:
        """Mean of the squared differences, in sigmas: 1 where path and telemetry agree."""
        return sum(e.chi2 for e in self.edges) / max(sum(e.count for e in self.edges), 1)

    @property
    def scale_trend_sigmas(self) -> float:
        """Slope of measured over present scale from keyframe to keyframe, in its own sigmas; 0 with
        too few measurements to say. It shows a slow drift that no single keyframe shows."""
        known = [(e.keyframe, *e.scale_apart) for e in self.edges if e.scale_apart is not None]
        if len(known) < LEAST_FOR_TREND:
            return 0.0
        number, apart, sigma = np.array(known).T
        line, covariance = np.polyfit(number, apart, 1, w=1.0 / sigma, cov="unscaled")
        left = (apart - np.polyval(line, number)) / sigma
        spread = max(float(left @ left) / (len(known) - 2), 1.0)
        return float(abs(line[0]) / np.sqrt(spread * covariance[0, 0]))

    @staticmethod
    def at(component: int, frame: WorldFrame, edges: Sequence[WorldEdge]) -> World:
        """The world at the frame that the estimator found."""
        return World(component, frame.T_nm.inverse(), edges)
