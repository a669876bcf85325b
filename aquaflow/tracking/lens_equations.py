"""The normal equations of the self-calibrating bundle adjustment (``lens_adjustment``)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.optics import (
    LENS_PRIOR_SIGMA,
    TERMS,
    by_lens,
    rays_of,
    seen_at,
    slope,
)
from aquaflow.geometry.similarity import hat, so3_exp
from aquaflow.optimise.least_squares import NormalEquations
from aquaflow.optimise.robust import HUBER_LENGTH, Huber

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

KERNEL = Huber(HUBER_LENGTH)
"""Of a match, by the length of its error."""
GAUGE_DAMPING = 1e-9
"""Of the mean diagonal: holds position, attitude and scale of the whole, which nothing measures."""
MIN_Z = 1e-3
"""Points behind a view are projected as if just in front of it, far outside of the picture."""


@dataclass(frozen=True)
class LensObservations:
    """P points, each sampled in one view, and their M matches in other views; normalised plane."""

    points: Array
    """[P, 2]"""
    reference: Indices
    """[P] the view that a point was sampled in."""
    point: Indices
    """[M]"""
    view: Indices
    """[M]"""
    matches: Array
    """[M, 2]"""


@dataclass(frozen=True)
class LensUnknowns:
    """The unknowns; V views."""

    R_wc: Array
    """[V, 3, 3]"""
    centres: Array
    """[V, 3]"""
    rho: Array
    """[P] inverse depth in the reference view."""
    lens: Array
    """[5] as in ``geometry.lens_error``."""


@dataclass(frozen=True)
class Weighting:
    """Huber's weights of matches whose noise is ``sigma``."""

    sigma: float
    """Normalised units."""
    used: npt.NDArray[np.bool_]
    """[M]"""

    def weights(
        self,
        error: Array,  # [M, 2] normalised plane
    ) -> Array:
        """[M] Huber's, over the variance; 0 for what is not used."""
        weight = KERNEL.weight(np.linalg.norm(error, axis=-1) / self.sigma)
        return np.asarray(np.where(self.used, weight / self.sigma**2, 0.0))

    def cost(
        self,
        error: Array,  # [M, 2] normalised plane
        lens: Array,  # [5]
    ) -> float:
        """Huber's, of residuals [M, 2], and the prior of the lens."""
        size = np.linalg.norm(error, axis=-1)[self.used] / self.sigma
        prior = 0.5 * float(np.sum((lens / LENS_PRIOR_SIGMA) ** 2))
        return float(KERNEL.cost(size).sum()) + prior


class LensEquations:
    """The normal equations at one state: 6 columns a view (centre, rotation), then the lens."""

    def __init__(
        self, observations: LensObservations, state: LensUnknowns, weighting: Weighting, terms: int
    ) -> None:
        self._observations, self._state = observations, state
        self._weighting, self._terms = weighting, terms
        error, J, along = _derivatives(observations, state)
        self._error = error
        weights, point = weighting.weights(error), observations.point
        self._wJ = weights[:, None, None] * J
        self._J, self._columns = J, _columns(observations, len(state.R_wc))
        count, width = len(state.rho), 6 * len(state.R_wc) + TERMS
        self._H_pp = 1e-9 + np.bincount(point, weights * np.sum(along**2, axis=1), count)
        self._g_p = np.bincount(point, weights * np.sum(along * error, axis=1), count)
        by_point = np.einsum("mr,mrk->mk", along, self._wJ)
        self._H_pc = _add_up(point[:, None] * width + self._columns, by_point, count * width)
        self._H_pc = self._H_pc.reshape(count, width)
        self._by_match = np.einsum("mrk,mr->mk", self._wJ, error)

    @cached_property
    def hessian(self) -> Array:
        """[C, C] the depths eliminated."""
        width = self._H_pc.shape[1]
        H = np.zeros((width, width))
        # Matches between the same two views depend on the same columns.
        pair = self._columns[:, 0] * width + self._columns[:, 6]
        order = np.argsort(pair, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(pair[order])) + 1):
            columns, size = self._columns[rows[0]], self._columns.shape[1]
            J, wJ = self._J[rows].reshape(-1, size), self._wJ[rows].reshape(-1, size)
            H[np.ix_(columns, columns)] += wJ.T @ J
        return np.asarray(H - (self._H_pc / self._H_pp[:, None]).T @ self._H_pc)

    def gradient_of(
        self,
        points: npt.NDArray[np.bool_],  # [P] which of them
    ) -> Array:
        """[C] of the ``points``, their depths eliminated."""
        rows, width = points[self._observations.point], self._H_pc.shape[1]
        direct = _add_up(self._columns[rows], self._by_match[rows], width)
        gain = self._g_p[points] / self._H_pp[points]
        return np.asarray(direct - gain @ self._H_pc[points])

    def hold_gauge(
        self,
        H: Array,  # [C, C]
    ) -> Array:
        """[C, C] with the prior of the lens and the gauge held."""
        extra = np.full(len(H), GAUGE_DAMPING * float(np.trace(H)) / len(H))
        extra[-TERMS:] += LENS_PRIOR_SIGMA**-2.0
        return H + np.diag(extra)

    @property
    def cost(self) -> float:
        """Robust, the prior of the lens included."""
        return self._weighting.cost(self._error, self._state.lens)

    @cached_property
    def gradient(self) -> Array:
        """[C] of the cost, the depths eliminated; 0 where the lens is held."""
        gradient = self.gradient_of(np.ones(len(self._state.rho), dtype=bool))
        gradient[-TERMS:] += self._state.lens / LENS_PRIOR_SIGMA**2
        gradient[len(gradient) - TERMS + self._terms :] = 0.0
        return gradient

    def solve(self, damping: float) -> Array | None:
        """[C] damped step of poses and lens, in which only the free terms of the lens move."""
        free = slice(0, len(self.gradient) - TERMS + self._terms)
        H = self.hold_gauge(self.hessian)[free, free]
        found = NormalEquations(H, self.gradient[free], self.cost).solve(damping)
        return None if found is None else np.append(found, np.zeros(TERMS - self._terms))

    def move(
        self,
        step: Array,  # [C]
    ) -> LensUnknowns:
        """The state after a step of poses and lens, and of the depths that fit best then."""
        state, moves = self._state, step[:-TERMS].reshape(-1, 6)
        R = np.stack([R @ so3_exp(move[3:]) for R, move in zip(state.R_wc, moves, strict=True)])
        rho = state.rho - (self._g_p + self._H_pc @ step) / self._H_pp
        return LensUnknowns(R, state.centres + moves[:, :3], rho, state.lens + step[-TERMS:])


class SelfCalibration:
    """The adjustment as a problem of least squares: the first ``terms`` of the lens are free."""

    def __init__(self, observations: LensObservations, weighting: Weighting, terms: int) -> None:
        self._observations, self._weighting, self._terms = observations, weighting, terms
        self._equations: LensEquations | None = None

    def linearise(self, state: LensUnknowns) -> LensEquations:
        """The equations of a step [C] of poses and lens."""
        self._equations = LensEquations(self._observations, state, self._weighting, self._terms)
        return self._equations

    def cost(self, state: LensUnknowns) -> float:
        """Robust, the prior of the lens included."""
        return self._weighting.cost(residuals(self._observations, state), state.lens)

    def move(
        self,
        state: LensUnknowns,
        step: Array,  # [P]
    ) -> LensUnknowns:
        """Poses, depths and lens after a step [C] from where they were linearised last."""
        assert self._equations is not None
        return self._equations.move(step)


def _columns(observations: LensObservations, views: int) -> Indices:
    """[M, 12 + TERMS] columns that a match depends on: its point's view, its own, the lens."""
    reference = observations.reference[observations.point]
    blocks = [6 * each[:, None] + np.arange(6) for each in (reference, observations.view)]
    lens = np.broadcast_to(6 * views + np.arange(TERMS), (len(reference), TERMS))
    return np.concatenate([*blocks, lens], axis=1)


def _add_up(
    where: Indices,  # [...] below size
    values: Array,  # [...]
    size: int,
) -> Array:
    """[size] sums of the values that go to the same place."""
    return np.asarray(np.bincount(where.ravel(), values.ravel(), size), dtype=np.float64)


def _transform(
    observations: LensObservations, state: LensUnknowns
) -> tuple[Array, Array, Array, Array]:
    """Of every match: its point's ray [M, 3], rotation into the view [M, 3, 3], the way between
    the views there [M, 3], and the point in the view [M, 3], scaled to depth 1 in the reference."""
    point, view = observations.point, observations.view
    reference = observations.reference[point]
    rays = rays_of(observations.points, state.lens)
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)[point]
    R_cw = np.swapaxes(state.R_wc, 1, 2)[view]
    R = R_cw @ state.R_wc[reference]
    way = _apply(R_cw, state.centres[reference] - state.centres[view])
    return rays, R, way, _apply(R, rays) + state.rho[point, None] * way


def residuals(observations: LensObservations, state: LensUnknowns) -> Array:
    """[M, 2] of the normalised plane as it was seen."""
    Y = _transform(observations, state)[-1]
    return seen_at(Y[:, :2] / np.maximum(Y[:, 2:], MIN_Z), state.lens) - observations.matches


def _derivatives(observations: LensObservations, state: LensUnknowns) -> tuple[Array, Array, Array]:
    """Residuals [M, 2], their derivatives [M, 2, 12 + TERMS] by the columns of ``_columns``, and
    [M, 2] by rho."""
    rays, R, way, Y = _transform(observations, state)
    z = np.maximum(Y[:, 2], MIN_Z)
    at = Y[:, :2] / z[:, None]
    project = np.zeros((len(at), 2, 3))
    project[:, 0, 0] = project[:, 1, 1] = 1.0 / z
    project[:, :, 2] = -at / z[:, None]
    D = slope(at, state.lens) @ project
    R_cw = np.swapaxes(state.R_wc, 1, 2)[observations.view]
    by_centre = D @ R_cw * state.rho[observations.point, None, None]
    bent = np.linalg.solve(slope(rays[:, :2], state.lens), by_lens(rays[:, :2], state.lens))
    by_errors = by_lens(at, state.lens) - D @ R[:, :, :2] @ bent
    parts = [by_centre, -D @ R @ hat(rays), -by_centre, D @ hat(Y), by_errors]
    error = seen_at(at, state.lens) - observations.matches
    return error, np.concatenate(parts, axis=2), _apply(D, way)


def triangulate(observations: LensObservations, state: LensUnknowns) -> Array:
    """[P] inverse depths, linear least squares."""
    rays, R, way, _ = _transform(observations, state)
    at_infinity, match = _apply(R, rays), rays_of(observations.matches, state.lens)
    slope = way[:, :2] - match * way[:, 2:]
    value = match * at_infinity[:, 2:] - at_infinity[:, :2]
    count, point = len(state.rho), observations.point
    top = np.bincount(point, np.sum(slope * value, axis=1), count)
    return np.asarray(top / np.maximum(np.bincount(point, np.sum(slope**2, axis=1), count), 1e-18))


def _apply(
    R: Array,  # [M, r, 3]
    vectors: Array,  # [M, 3]
) -> Array:
    """[M, r] = R [M, r, 3] @ vectors [M, 3]."""
    return np.asarray(np.einsum("mij,mj->mi", R, vectors))
