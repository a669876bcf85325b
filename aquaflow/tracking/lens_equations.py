"""Self-calibrating bundle adjustment: its keypoint matches, its normal equations, its solution."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import (
    LENS_PRIOR_SIGMA,
    TERMS,
    by_lens,
    rays_of,
    seen_at,
    slope,
)
from aquaflow.geometry.similarity import Sim3, hat, so3_exp
from aquaflow.optimise.least_squares import NormalEquations, Rules, minimise
from aquaflow.optimise.robust import HUBER_LENGTH, Huber, sigma_of_lengths
from aquaflow.prior.contract import Keypoints, Mask
from aquaflow.tracking.loops import Index, match_keypoints

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


# --------------------------------------------------------------------------------------------------
# Self-calibrating bundle adjustment: poses, inverse depths, and one error of the lens for all.
#
# Every point belongs to the view that it was sampled in, so that the points' block of the normal
# equations is diagonal.

ROUNDS = 4
"""Of weighting: in the first the lens is held, in the last two outliers are left out."""
RULES = Rules(iterations=40, decrease=1e-6, growth=4.0, shrinkage=0.25)
"""Of each round; from a focal length 30 % off it takes about ten iterations. Where the lens is
badly known, the cost, some ten thousand, is flat. With damping that changes tenfold, every other
step along the narrow valley in which focal length and poses compensate each other fails
(measured)."""
OUTLIER_SIGMAS = 6.0
"""Mismatches of keypoints lie tens of standard deviations off; the error of a lens does not."""
MIN_SIGMA = 1e-6
"""Normalised units; noise below a thousandth of a pixel is a test without any."""


@dataclass(frozen=True)
class LensAdjustment:
    """The solution and its uncertainty."""

    adjusted: LensUnknowns
    covariance: Array
    """[2, 2] of u and k, from the scatter between the views: matches of one view share errors."""
    sigma_held: float
    """Noise of the matches, normalised units, that the calibration as it is leaves."""
    sigma: float
    """Noise of the matches with u and k solved for."""


def adjust_lens(
    observations: LensObservations,
    R_wc: Array,  # [V, 3, 3]
    centres: Array,  # [V, 3]
    terms: int,
    start: Array | None = None,  # [5] lens error, 0 if None
) -> LensAdjustment:
    """The first ``terms`` of the lens error that fit ``observations`` best; the others stay as in
    ``start``, with which the poses go.

    Raises:
        numpy.linalg.LinAlgError: the matches determine nothing at all.
    """
    lens = np.zeros(TERMS) if start is None else start
    state = LensUnknowns(R_wc, centres, np.ones(len(observations.points)), lens)
    sigmas: list[float] = []
    weighting = Weighting(1.0, np.zeros(0, dtype=bool))
    for number in range(ROUNDS):
        state = replace(state, rho=triangulate(observations, state))
        size = np.linalg.norm(residuals(observations, state), axis=-1)
        ahead = state.rho[observations.point] > 0.0
        sigma = _sigma(size[ahead])
        used = ahead if number < ROUNDS - 2 else ahead & (size < OUTLIER_SIGMAS * sigma)
        weighting = Weighting(sigma, used)
        problem = SelfCalibration(observations, weighting, terms if number else 0)
        state = minimise(problem, state, RULES).state
        sigmas.append(_sigma(np.linalg.norm(residuals(observations, state), axis=-1)[used]))
    covariance = _covariance(observations, state, weighting, terms)
    return LensAdjustment(state, covariance, sigmas[0], sigmas[-1])


def _covariance(
    observations: LensObservations, state: LensUnknowns, weighting: Weighting, terms: int
) -> Array:
    """[2, 2] of the lens: the sandwich estimator over the clusters of the points."""
    clusters = clusters_of(observations)
    count = len(np.unique(clusters))
    equations = LensEquations(observations, state, weighting, terms)
    H = equations.hessian
    free = slice(0, len(H) - TERMS + terms)
    inverse: Array = np.asarray(
        np.linalg.inv(equations.hold_gauge(H)[free, free]), dtype=np.float64
    )
    scatter = np.zeros_like(inverse)
    for cluster in np.unique(clusters):
        gradient = equations.gradient_of(clusters == cluster)
        scatter += np.outer(gradient[free], gradient[free]) * count / (count - 1.0)
    lens = slice(len(inverse) - terms, len(inverse) - terms + 2)
    sandwich = (inverse @ scatter @ inverse)[lens, lens]
    # Few clusters may agree by chance better than the noise of their matches lets them.
    return _larger(sandwich, inverse[lens, lens])


def model_error(simple: LensAdjustment, full: LensAdjustment) -> Array:
    """[2, 2] Of a lens of two terms: where more terms explain part of the noise, that part of the
    estimates' difference is a matter of the model and not of the calibration."""
    explained = max(0.0, 1.0 - (full.sigma / simple.sigma) ** 2)
    difference = full.adjusted.lens[:2] - simple.adjusted.lens[:2]
    return np.diag(explained * difference**2)


def clusters_of(observations: LensObservations) -> Indices:
    """[P] number of the view and quarter of the picture that each point was sampled in."""
    right, lower = (observations.points > 0.0).T
    return np.asarray(4 * observations.reference + 2 * lower + right, dtype=np.int64)


def _larger(
    a: Array,  # [2, 2]
    b: Array,  # [2, 2]
) -> Array:
    """[2, 2] a covariance that is nowhere smaller than either."""
    root = np.linalg.cholesky(b)
    whitened = np.linalg.solve(root, np.linalg.solve(root, a).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    return np.asarray(root @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ root.T)


def _sigma(
    size: Array,  # [M] lengths of residuals, normalised plane
) -> float:
    return max(sigma_of_lengths(size), MIN_SIGMA)


# --------------------------------------------------------------------------------------------------
# Keypoint matches between pictures as observations of points, for an adjustment of the lens.

MATCHES_PER_PAIR = 200
"""At most; of more, an even choice: matches of one pair of views share errors."""
MIN_MATCHES = 300
"""Of all pairs together."""
MIN_PAIR_MATCHES = 20
"""Of one pair: as many mismatches are found between pictures of different places."""

Seen = tuple[int, int]
"""A keypoint: the number of its view, and its own there."""


@dataclass(frozen=True)
class LensView:
    """A picture whose keypoints show the lens."""

    keypoints: Keypoints
    camera: CameraModel
    """The one whose error is asked for."""
    T_wc: Sim3
    """Roughly right."""

    def where(
        self,
        shown: Mask | None,  # [H, W] True where the scene is seen; None: everywhere
    ) -> LensView:
        """The view with its keypoints there."""
        if shown is None:
            return self
        height, width = shown.shape
        column, row = np.floor(self.keypoints.pixels).astype(np.intp).T
        kept = shown[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        pixels, descriptors = self.keypoints.pixels[kept], self.keypoints.descriptors[kept]
        return replace(self, keypoints=Keypoints(pixels, descriptors))


class _Points:
    """Points by the keypoints that see them; the first keypoint is where a point is sampled."""

    def __init__(self) -> None:
        self.seen: list[list[Seen]] = []
        self._owner: dict[Seen, int] = {}

    def is_known(self, keypoint: Seen) -> bool:
        return keypoint in self._owner

    def add(self, a: Seen, b: Seen) -> None:
        """They see the same; what contradicts an earlier match is left out."""
        if b in self._owner:
            return
        point = self._owner.get(a)
        if point is None:
            point = self._owner[a] = len(self.seen)
            self.seen.append([a])
        if all(view != b[0] for view, _ in self.seen[point]):
            self.seen[point].append(b)
            self._owner[b] = point


Found = TypeVar("Found")


def solve_matched(
    views: Sequence[LensView],
    pairs: Iterable[tuple[int, int]],
    solve: Callable[[LensObservations, Array, Array], Found],
) -> Found | None:
    """What ``solve`` finds from the matches of ``pairs``, and from rotations [V, 3, 3] and centres
    [V, 3] of ``views`` in the world; None where too little matches, or that determines nothing."""
    observations = match_pixels(views, pairs)
    if observations is None:
        return None
    R_wc = np.stack([view.T_wc.R for view in views])
    centres = np.stack([view.T_wc.t for view in views])
    try:
        return solve(observations, R_wc, centres)
    except np.linalg.LinAlgError:
        return None


def match_pixels(
    views: Sequence[LensView], pairs: Iterable[tuple[int, int]]
) -> LensObservations | None:
    """Points seen in several of ``views``, by matches of ``pairs`` (i, j) with i < j; None for too
    few. A keypoint belongs to one point, so that no match counts twice."""
    points = _Points()
    for i, j in sorted(pairs):
        mine, theirs = match_keypoints(views[i].keypoints, views[j].keypoints)
        if len(mine) < MIN_PAIR_MATCHES:
            continue
        known = np.array([points.is_known((i, a)) for a in mine.tolist()])
        for row in _choose(known).tolist():
            points.add((i, int(mine[row])), (j, int(theirs[row])))
    seen = [each for each in points.seen if len(each) > 1]
    if sum(len(each) - 1 for each in seen) < MIN_MATCHES:
        return None
    plane = [view.camera.unproject(view.keypoints.pixels)[:, :2] for view in views]
    matches = [(row, *keypoint) for row, each in enumerate(seen) for keypoint in each[1:]]
    return LensObservations(
        np.stack([plane[view][keypoint] for (view, keypoint), *_ in seen]),
        np.array([view for (view, _), *_ in seen], dtype=np.int64),
        np.array([row for row, _, _ in matches], dtype=np.int64),
        np.array([view for _, view, _ in matches], dtype=np.int64),
        np.stack([plane[view][keypoint] for _, view, keypoint in matches]),
    )


def _choose(
    known: np.ndarray[tuple[int], np.dtype[np.bool_]],  # [M] whether another view sees it too
) -> Index:
    """Rows of the matches used: first of points that other views see, then an even choice."""
    longer, single = np.flatnonzero(known), np.flatnonzero(~known)
    room = max(0, MATCHES_PER_PAIR - len(longer))
    step = max(1, -(-len(single) // room)) if room else len(single) + 1
    return np.concatenate([longer[:: max(1, -(-len(longer) // MATCHES_PER_PAIR))], single[::step]])
