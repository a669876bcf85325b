"""One joint adjustment: noise estimated, outliers left out, judged by points held out of it.

Below: its least-squares problem in blocks, and the uncertainty of what it found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.optimise.least_squares import NormalEquations, Rules, minimise
from aquaflow.optimise.robust import sigma_of_lengths
from aquaflow.tracking.adjustment.equations import (
    KERNEL,
    AnchorEquations,
    AnchorMatches,
    Array,
    Index,
    Links,
    Mask,
    anchor_equations,
    equations_and_scores,
    error_lengths,
    project,
)
from aquaflow.tracking.adjustment.stored_matches import Judged, Matches, StoredMatches

ROUNDS = 3
"""Of noise and descent; from the second on outliers are left out."""
OUTLIER_SIGMAS = 6.0
"""Noise has none; matches of another surface lie tens of standard deviations off."""
LEAST_SIGMA = 2e-5
"""Normalised plane: a hundredth of a pixel; only matches that were made up are as good."""
FEW = 10
"""Matches of a pair below which their noise says nothing: they are left out."""
LEAST_JUDGES = 20
"""Held-out points below which nothing is judged, and nothing kept."""
LEAST_GAIN = 3.0
"""Standard errors, errors in common counted, by which the held-out points must fit better."""


@dataclass(frozen=True)
class JointProblem:
    """What is to be adjusted."""

    matches: Matches
    held_out: Sequence[Mask]
    """[P] of each anchor: points that judge."""
    links: Links
    poses: Sim3Batch
    """[K]"""
    free: Mask
    """[K]"""
    folder: Path | None = None
    """For a file of matches that are more than MATCHES_BYTES; None: all stay in memory."""


@dataclass(frozen=True)
class JointAdjustmentResult:
    """What came of it."""

    state: BundleState
    matches: Matches
    """Without held-out points and outliers; their noise as found, grown for errors in common."""
    verdict: HeldOutVerdict

    @property
    def better(self) -> bool:
        """True if the points that took no part fit better than before, beyond chance."""
        enough = self.verdict.points >= LEAST_JUDGES
        return enough and self.verdict.gain_sigmas > LEAST_GAIN


def adjust(problem: JointProblem, iterations: int) -> JointAdjustmentResult:
    """Adjust poses and depths; ``iterations`` bounds each of ``ROUNDS`` descents.

    Raises:
        numpy.linalg.LinAlgError: the equations hold no numbers.
    """
    matches = StoredMatches.of(
        (only(each, ~held) for each, held in _with_masks(problem)), problem.folder
    )
    state = BundleState(problem.poses, [_start_depths(each, problem.poses) for each in matches])
    matches = _judged(matches, _with_noise, state)
    for number in range(ROUNDS):
        used = matches if number == 0 else _judged(matches, _without_outliers, state)
        state = descend(used, problem.links, state, problem.free, iterations)
        matches = _judged(matches, _with_noise, state)
    used = _judged(matches, _without_outliers, state)
    grown = float(np.sqrt(inflation(used, problem.links, state, problem.free)))
    used = used.judged_as((grown * sigma, mask) for sigma, mask in used.judged)
    judges = (
        replace(only(each, held), sigma=sigma)
        for (each, held), (sigma, _) in zip(_with_masks(problem), matches.judged, strict=True)
    )
    state = descend(used, problem.links, state, problem.free, iterations)
    return JointAdjustmentResult(state, used, verdict(judges, problem.poses, state.poses, grown))


def _with_masks(problem: JointProblem) -> Iterator[tuple[AnchorMatches, Mask]]:
    return zip(problem.matches, problem.held_out, strict=True)


def _judged(
    matches: StoredMatches,
    judge: Callable[[AnchorMatches, Sim3Batch, Array], Judged],
    state: BundleState,
) -> StoredMatches:
    """The matches with the noise, and without those that are not used, as ``judge`` finds them."""
    pairs = zip(matches, state.rho, strict=True)
    return matches.judged_as(judge(each, state.poses, rho) for each, rho in pairs)


def _start_depths(matches: AnchorMatches, poses: Sim3Batch) -> Array:
    """[P] depths of the pointmap; triangulate where it has none."""
    unknown = ~np.isfinite(matches.variance)
    if not unknown.any():
        return matches.rho
    return np.where(unknown, triangulate(matches, poses), matches.rho)


def _with_noise(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> Judged:
    """The noise of every pair's matches from what is left of them; pairs of few are left out."""
    size = error_lengths(matches, poses, rho)
    many = matches.used.sum(axis=1) >= FEW
    sigma = np.array([
        max(sigma_of_lengths(row[used]), LEAST_SIGMA) if enough else 1.0
        for row, used, enough in zip(size, matches.used, many, strict=True)
    ])  # fmt: skip
    return sigma, matches.used & many[:, None]


def _without_outliers(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> Judged:
    size = error_lengths(matches, poses, rho)
    near = size < OUTLIER_SIGMAS * matches.sigma[:, None]
    return matches.sigma, matches.used & near


# --------------------------------------------------------------------------------------------------
# The judge of an adjustment: reprojection error of points that took no part in it.
#
# Their depths are triangulate from the poses that are judged, so no depth of a pointmap is asked.

REFINEMENTS = 2
"""Gauss-Newton steps from the linear solution: the error is then the least there is."""


def held_out_errors(anchor: AnchorMatches, poses: Sim3Batch) -> Array:
    """[V, P] lengths of the errors in sigmas of an anchor; NaN where nothing is seen."""
    size = error_lengths(anchor, poses, triangulate(anchor, poses)) / anchor.sigma[:, None]
    return np.where(anchor.used, size, np.nan)


@dataclass(frozen=True)
class HeldOutVerdict:
    """What points that took no part say of two sets of poses."""

    before: float
    """Mean robust cost of their matches, in sigmas."""
    after: float
    gain_sigmas: float
    """Mean fall of a point's cost, over its standard error: from the scatter from point to point,
    and grown, because matches err together."""
    points: int


def verdict(
    matches: Iterable[AnchorMatches], before: Sim3Batch, after: Sim3Batch, grown: float = 1.0
) -> HeldOutVerdict:
    """Compare poses [K] by the matches of points held out of the adjustment; errors in common make
    their standard error ``grown`` times that of independent ones."""
    falls, costs, count = [], np.zeros(2), 0
    for anchor in matches:
        old, new = held_out_errors(anchor, before), held_out_errors(anchor, after)
        seen = np.isfinite(old) & np.isfinite(new)
        cost = [np.where(seen, KERNEL.cost(np.where(seen, each, 0.0)), 0.0) for each in (old, new)]
        falls.append((cost[0] - cost[1]).sum(0)[seen.any(0)])
        costs += cost[0].sum(), cost[1].sum()
        count += int(seen.sum())
    fall = np.concatenate(falls) if falls else np.zeros(0)
    if len(fall) < 2:
        return HeldOutVerdict(float("nan"), float("nan"), 0.0, len(fall))
    spread = max(grown * float(fall.std()) / np.sqrt(len(fall)), 1e-12)
    return HeldOutVerdict(
        costs[0] / count, costs[1] / count, float(fall.mean()) / spread, len(fall)
    )


def triangulate(matches: AnchorMatches, poses: Sim3Batch) -> Array:
    """[P] inverse depths that fit the matches best, whatever the pointmap says; 0 at infinity."""
    at = project(matches, poses, np.zeros(len(matches.rays)))
    weight = np.where(matches.used, 1.0 / matches.sigma[:, None] ** 2, 0.0)
    seen = np.where(matches.used[..., None], matches.at, 0.0)
    way = at.t[:, None, :2] - seen * at.t[:, None, 2:]
    value = seen * at.Y[..., 2:] - at.Y[..., :2]
    rho = _ratio((weight * (way * value).sum(-1)).sum(0), (weight * (way**2).sum(-1)).sum(0))
    for _ in range(REFINEMENTS):
        at = project(matches, poses, rho)
        slope = at.t[:, None, :2] / at.z[..., None] - at.Y[..., :2] * (
            at.t[:, None, 2:] / (at.z**2)[..., None]
        )
        top = (weight * (slope * at.error).sum(-1)).sum(0)
        rho = rho - _ratio(top, (weight * (slope**2).sum(-1)).sum(0))
    return np.maximum(rho, 0.0)


def _ratio(
    top: Array,  # [P]
    bottom: Array,  # [P]
) -> Array:
    return np.asarray(top / np.maximum(bottom, 1e-12))


def only(
    matches: AnchorMatches,
    points: Mask,  # [P]
) -> AnchorMatches:
    """The matches of some of the points."""
    return replace(
        matches, rays=matches.rays[points], rho=matches.rho[points],
        variance=matches.variance[points], at=matches.at[:, points],
        used=matches.used[:, points],
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------
# A joint adjustment as a problem of least squares: poses step, and depths follow.

DECREASE = 1e-4
"""Relative fall of the cost at which a descent ends."""
DENSE_UNKNOWNS = 700
"""Up to a hundred keyframes a dense factor is quicker than a sparse one."""
KEPT_BYTES = 64 << 20
"""What steps of depths are kept from, 0.1 MB for each anchor; making them anew takes as long as the
equations did."""


@dataclass(frozen=True)
class BundleState:
    """What is solved for."""

    poses: Sim3Batch
    """[K] T_wc; the scale is the unit of the keyframe's depths."""
    rho: Sequence[Array]
    """[P] of each anchor."""


def cost_of(matches: Matches, links: Links, state: BundleState) -> float:
    """Robust cost of all matches, and of the depths' departure from the pointmaps."""
    total = links.cost(state.poses)
    for anchor, rho in zip(matches, state.rho, strict=True):
        size = error_lengths(anchor, state.poses, rho) / anchor.sigma[:, None]
        total += float(KERNEL.cost(size).sum())
        total += 0.5 * float(((rho - anchor.rho) ** 2 / anchor.variance).sum())
    return total


def descend(
    matches: Matches,
    links: Links,
    state: BundleState,
    free: Mask,  # [K] which poses may move
    iterations: int,
) -> BundleState:
    """The state of least cost, or the best that ``iterations`` steps find."""
    problem = JointAdjustment(matches, links, free)
    return minimise(problem, state, Rules(iterations, decrease=DECREASE)).state


class JointAdjustment:
    """Matches and links; F poses are free."""

    def __init__(
        self,
        matches: Matches,
        links: Links,
        free: Mask,  # [K]
    ) -> None:
        self._matches, self._links, self._free = matches, links, free
        self._pattern = BlockPattern.of(matches, links, free)
        self._system: System | None = None
        self._known: tuple[BundleState, float] | None = None

    def cost(self, state: BundleState) -> float:
        """Robust; infinite where a pose is none."""
        if self._known is None or self._known[0] is not state:
            poses = state.poses
            sound = np.isfinite(poses.t).all() and (poses.scale > 0.0).all()
            cost = cost_of(self._matches, self._links, state) if sound else float("inf")
            self._known = state, cost
        return self._known[1]

    def linearise(self, state: BundleState) -> System:
        """The equations of a step [7 F]."""
        self._system = None  # two of them would be twice KEPT_BYTES
        system = linearise(self._matches, self._links, state, self._pattern)
        self._system = replace(system, cost=self.cost(state))
        return self._system

    def move(
        self,
        state: BundleState,
        step: Array,  # [P]
    ) -> BundleState:
        """Poses moved by a step [7 F], and the depths that fit best then, to first order."""
        assert self._system is not None
        whole = np.zeros((len(state.poses), 7))
        whole[self._free] = step.reshape(-1, 7)
        rho, parts = [], self._system.parts
        for i, (anchor, depths) in enumerate(zip(self._matches, state.rho, strict=True)):
            part = parts[i] if i < len(parts) else anchor_equations(anchor, state.poses, depths)
            rho.append(depths + part.depth_steps(whole[anchor.places].ravel()))
        return BundleState((state.poses @ Sim3Batch.exp(whole)).on_group(), rho)


@dataclass(frozen=True)
class System:
    """The equations at one state."""

    H: sparse.csc_matrix
    """[7 F, 7 F] of the free poses, depths eliminated."""
    gradient: Array
    """[7 F]"""
    parts: Sequence[AnchorEquations]
    """Of the first anchors, as many as KEPT_BYTES hold: those of the others are made anew when
    their depths step."""
    cost: float = float("nan")

    def solve(self, damping: float) -> Array | None:
        """[7 F] damped step of the free poses; None where the equations are singular."""
        if len(self.gradient) <= DENSE_UNKNOWNS:
            return NormalEquations(self.H.toarray(), self.gradient, self.cost).solve(damping)
        diagonal = self.H.diagonal()
        least = 1e-12 * max(float(diagonal.max(initial=0.0)), 1e-12)
        H = self.H + sparse.diags((damping * diagonal) + least, format="csc")
        try:
            factor = splu(H, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        except RuntimeError:
            return None
        step = np.asarray(-factor.solve(self.gradient))
        return step if np.isfinite(step).all() else None


def linearise(matches: Matches, links: Links, state: BundleState, pattern: BlockPattern) -> System:
    """The equations of all anchors and links, summed anchor by anchor."""
    total, kept, room = pattern.zero(), list[AnchorEquations](), KEPT_BYTES
    for anchor, rho in zip(matches, state.rho, strict=True):
        part = anchor_equations(anchor, state.poses, rho)
        total.add(pattern.place[anchor.places], part.H, part.gradient)
        room -= part.gain.nbytes + part.H.nbytes
        if room >= 0:
            kept.append(part)
    ends = pattern.place[np.stack([links.a, links.b], axis=1)]
    for places, H, gradient in zip(ends, *links.blocks(state.poses), strict=True):
        total.add(places, H, gradient)
    return System(total.matrix(), total.gradient, kept)


# --------------------------------------------------------------------------------------------------
# A sparse symmetric matrix of 7 x 7 blocks, one for each pair of poses, that sums are made in.
#
# Where its blocks are is known before they are: so a sum over anchors needs no more than the blocks
# themselves, where a list of all that is to be summed would be several times as large.

SIDE = 7
"""Of a block: the degrees of freedom of a similarity."""


@dataclass(frozen=True)
class BlockPattern:
    """Which pairs of F free poses have a block."""

    place: Index
    """[K] of every pose among the free ones; -1 for those that are held."""
    free: int
    """F"""
    keys: Index
    """[B] row times F plus column of every block, increasing."""

    @staticmethod
    def of(
        matches: Matches,
        links: Links,
        free: Mask,  # [K]
    ) -> BlockPattern:
        """Poses that an anchor's points, or a link, bring together."""
        place, count = np.full(len(free), -1, dtype=np.intp), int(free.sum())
        place[free] = np.arange(count)
        groups = [place[each.places] for each in matches]
        groups += list(place[np.stack([links.a, links.b], axis=1)])
        keys = [_keys(group[group >= 0], count) for group in groups]
        found = np.unique(np.concatenate(keys)) if keys else np.zeros(0, np.intp)
        return BlockPattern(place, count, found)

    def zero(self) -> BlockSum:
        """A sum of nothing so far."""
        blocks = np.zeros((len(self.keys), SIDE, SIDE))
        return BlockSum(self, blocks, np.zeros(SIDE * self.free))


@dataclass(frozen=True)
class BlockSum:
    """Equations of the free poses, while parts are added."""

    pattern: BlockPattern
    blocks: Array
    """[B, 7, 7]"""
    gradient: Array
    """[7 F]"""

    def add(
        self,
        places: Index,  # [n] among the free poses, each once; -1 for those that are held
        H: Array,  # [7 n, 7 n]
        gradient: Array,  # [7 n]
    ) -> None:
        """Add the equations of some poses; what belongs to held ones is left out."""
        inside = np.flatnonzero(places >= 0)
        at = places[inside]
        count = len(places)
        parts = H.reshape(count, SIDE, count, SIDE).transpose(0, 2, 1, 3)
        where = np.searchsorted(self.pattern.keys, _keys(at, self.pattern.free))
        self.blocks[where] += parts[np.ix_(inside, inside)].reshape(-1, SIDE, SIDE)
        self.gradient.reshape(-1, SIDE)[at] += gradient.reshape(count, SIDE)[inside]

    def matrix(self) -> sparse.csc_matrix:
        """[7 F, 7 F]"""
        size, keys = SIDE * self.pattern.free, self.pattern.keys
        if len(keys) == 0:
            return sparse.csc_matrix((size, size))
        rows, columns = np.divmod(keys, self.pattern.free)
        starts = np.searchsorted(rows, np.arange(self.pattern.free + 1))
        return sparse.bsr_matrix((self.blocks, columns, starts), shape=(size, size)).tocsc()


def _keys(
    places: Index,  # [n] among the free poses
    free: int,
) -> Index:
    """[n n] of the blocks between them."""
    return np.asarray((places[:, None] * free + places).ravel())


# --------------------------------------------------------------------------------------------------
# How well an adjustment knows the relative poses that it found.

CLUSTER = 4
"""Consecutive points of an anchor, row by row, whose errors count as one draw: neighbouring matches
err together. Clusters of 1, 4 and 16 points: 1.4, 1.9 and 1.7 times the variance (reef clip)."""
DENSE_POSES = 100
"""Above, the inverse of the equations is not worth its time: the usual factor is taken."""
USUAL_INFLATION = 1.8
"""Read off five real clips and three synthetic dives: 1.5 to 2.7."""


def covariance(
    matches: Matches,
    links: Links,
    state: BundleState,
    free: Mask,  # [K]
) -> Array:
    """[7 F, 7 F] of the steps of the free poses, seen from those that are held.

    Raises:
        numpy.linalg.LinAlgError: a pose is not determined at all.
    """
    pattern = BlockPattern.of(matches, links, free)
    return np.asarray(np.linalg.inv(linearise(matches, links, state, pattern).H.toarray()))


def inflation(
    matches: Matches,
    links: Links,
    state: BundleState,
    free: Mask,  # [K]
) -> float:
    """Factor of the variance by which matches that err together are worth less than independent
    ones: by how much more the pulls of clusters vary than the noise alone would make them
    (cluster-robust variance: Liang and Zeger, Biometrika 1986); at least 1.

    Raises:
        numpy.linalg.LinAlgError: a pose is not determined at all.
    """
    if free.sum() > DENSE_POSES:
        return USUAL_INFLATION
    inverse = covariance(matches, links, state, free)
    place = np.where(free, np.cumsum(free) - 1, -1)
    variation, expected = 0.0, 0.0
    for anchor, rho in zip(matches, state.rho, strict=True):
        part, scores = equations_and_scores(anchor, state.poses, rho)
        at, inside = unknowns(place[anchor.places])
        starts = np.arange(0, len(scores), CLUSTER)
        scores = np.add.reduceat(scores[:, inside], starts) if len(starts) else scores
        own = inverse[np.ix_(at, at)]
        variation += float(((scores @ own) * scores).sum()) if len(starts) else 0.0
        expected += float((part.H[np.ix_(inside, inside)] * own).sum())
    return max(1.0, variation / max(expected, 1e-12))


def of_edge(
    inverse: Array,  # [7 F, 7 F]
    place: Index,  # [K] of every pose among the free ones; -1 where held
    a: int,
    b: int,
    T_ab: Sim3Batch,  # [1]
) -> Array:
    """[7, 7] covariance of T_ab exp(d), between the poses a and b."""
    back = -T_ab.inverse().adjoint()[0]
    J = np.zeros((7, len(inverse)))
    for pose, by_pose in ((a, back), (b, np.eye(7))):
        if place[pose] >= 0:
            J[:, 7 * place[pose] : 7 * place[pose] + 7] = by_pose
    return np.asarray(J @ inverse @ J.T)


def unknowns(
    places: Index,  # [1 + V] among the free poses; -1 for those that are held
) -> tuple[Index, Index]:
    """Unknowns [u] of the free ones among ``places``, and where they stand in their block [u]."""
    columns = (SIDE * places[:, None] + np.arange(SIDE)).ravel()
    inside = np.flatnonzero(np.repeat(places >= 0, SIDE))
    return columns[inside], inside
