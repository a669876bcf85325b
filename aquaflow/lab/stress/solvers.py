"""Systems of equations that cannot be solved, or only just; and the group under long use."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3, so3_exp, so3_log
from aquaflow.geometry.two_view import relative_pose, triangulate
from aquaflow.lab.stress.case import Check, case
from aquaflow.lab.stress.swim import CAMERA, pose
from aquaflow.prior.homography import flow_of_homography
from aquaflow.tracking.initialisation.bundle import Bundle, adjust
from aquaflow.tracking.pose.matcher import pose_from_scratch
from aquaflow.tracking.pose.solver import PoseProblem, solve_pose

Array = npt.NDArray[np.float64]

POINTS = 300
TRUTH = pose((0.1, -0.05, 0.02), (0.02, -0.03, 0.05))
"""Of each problem: its points, and the pose to be found, m and rad."""


def _pixels(seed: int, count: int = POINTS) -> Array:
    """[count, 2] px all over the picture."""
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(2, 158, count), rng.uniform(2, 118, count)], -1)


def _points(seed: int) -> Array:
    """[POINTS, 3] m in the keyframe."""
    depth = np.random.default_rng([seed, 1]).uniform(0.8, 2.5, (POINTS, 1))
    return CAMERA.unproject(_pixels(seed)) * depth


def _problem(
    points: Array,  # [N, 3]
    pixels: Array,  # [N, 2] px
) -> PoseProblem:
    return PoseProblem(
        points, np.full(len(points), 1e-6), pixels, np.ones(len(points)), CAMERA, 0.5
    )


@case("solvers", "optimise.least_squares.NormalEquations.solve")
def rank_deficient(check: Check, seed: int) -> None:
    """Matches that are all one match, that lie on one ray, or that weigh nothing."""
    points = _points(seed)
    same = np.repeat(points[:1], POINTS, axis=0)
    ray = points[:1] * np.linspace(0.5, 3.0, POINTS)[:, None]
    for hard in (same, ray):
        _finite_or_none(check, _problem(hard, CAMERA.project(TRUTH.apply(hard))))
    weightless = _problem(points, CAMERA.project(TRUTH.apply(points)))
    weightless.weights[:] = 0.0
    _finite_or_none(check, weightless)


@case("solvers", "optimise.least_squares.NormalEquations.solve")
def contradictory_matches(check: Check, seed: int) -> None:
    """Every match points somewhere else."""
    _finite_or_none(check, _problem(_points(seed), _pixels(seed + 1)))


def _finite_or_none(check: Check, problem: PoseProblem) -> None:
    estimate = solve_pose(problem, Sim3.identity())
    if estimate is not None:
        check.pose("pose", estimate.T)
        check.finite("estimate", estimate.covariance, estimate.inlier_share, estimate.conditioning)


@case("solvers", "tracking.pose.matcher.pose_from_scratch")
def outliers_95_percent(check: Check, seed: int) -> None:
    """Nineteen matches of twenty are wrong: the pose is right, or there is none."""
    many = np.concatenate([_points(seed + i) for i in range(8)])
    pixels = CAMERA.project(TRUTH.apply(many))
    wrong = np.random.default_rng(seed).random(len(many)) < 0.95
    pixels[wrong] = _pixels(seed, int(wrong.sum()))
    problem = _problem(many, pixels)
    guess = pose_from_scratch(problem)
    if guess is None:
        return
    estimate = solve_pose(problem, guess)
    check.true("consensus is solved", estimate is not None)
    if estimate is not None:
        check.pose("pose", estimate.T)
        check.below("position error in m", float(np.abs(estimate.T.t - TRUTH.t).max()), 0.02)
        check.below("inlier share", estimate.inlier_share, 0.2)


@case("solvers", "tracking.initialisation.bundle.is_measured")
def nan_matches_in_bundle(check: Check, seed: int) -> None:
    """One match that is no number costs that match."""
    points = _points(seed)
    pixels = CAMERA.project(TRUTH.apply(points))[None].copy()
    pixels[0, 3] = np.nan
    observed = np.ones((1, POINTS), dtype=bool)
    start = Bundle([Sim3.identity()], 1.0 / points[:, 2], CAMERA)
    result = adjust(CAMERA.project(points), pixels, observed, start)
    check.pose("view", result.bundle.T[0])
    check.finite("inverse depths", result.bundle.rho, result.rho_sigma)
    check.below("median reprojection error in px", result.residual_px, 0.051)


@case("solvers", "geometry.two_view.MIN_DEPTH")
def points_behind_the_camera(check: Check, seed: int) -> None:
    """Matches that meet behind the cameras, or all but on them, are no measurement."""
    points = _points(seed)
    rays = points / points[:, 2:]
    backwards = Sim3(TRUTH.R, -TRUTH.t)
    near = Sim3(TRUTH.R, 1e-4 * TRUTH.t)
    seen = CAMERA.project(TRUTH.apply(points))
    for T in (backwards, near):
        result = triangulate(rays, seen, T, CAMERA, 0.5)
        check.finite("inverse depths", result.rho, result.variance)
        check.true("none is good", not bool(result.good.any()))


@case("solvers", "geometry.two_view.MIN_PARALLAX_RAD")
def parallel_rays(check: Check, seed: int) -> None:
    """Without translation, and with points at infinity, there is no depth."""
    points = _points(seed)
    rays = points / points[:, 2:]
    for T in (pose((0.0, 0.0, 0.0), (0.01, 0.0, 0.02)), pose((1e-4, 0.0, 0.0))):
        result = triangulate(rays, CAMERA.project(T.apply(rays)), T, CAMERA, 0.5)
        check.finite("inverse depths", result.rho, result.variance)
        check.true("none is good", not bool(result.good.any()))


@case("solvers", "geometry.camera.MIN_DEPTH")
def projection_at_depth_0(check: Check, seed: int) -> None:
    """Points on and behind the image plane's parallel through the camera centre."""
    points = _points(seed)
    points[::3, 2], points[1::3, 2] = 0.0, -points[1::3, 2]
    points[0] = 0.0
    check.finite("pixels", CAMERA.project(points))


@case("solvers", "prior.homography.MIN_DENOMINATOR")
def homography_horizon(check: Check, seed: int) -> None:
    """A homography whose horizon runs through pixel centres."""
    column = 10.5 + seed % 50
    H = np.array([[1.0, 0.0, -column], [0.0, 1.0, 0.0], [1.0, 0.0, -column]])
    flow = flow_of_homography(H, CAMERA.height, CAMERA.width)
    check.finite("flow", flow)
    check.below("largest flow in px", float(np.abs(flow).max()), 2.0 * (120 + 160))


@case("solvers", "geometry.two_view.MIN_MATCHES")
def degenerate_two_view(check: Check, seed: int) -> None:
    """Identical, collinear and random matches: a sound pose or none."""
    a = _pixels(seed)
    line = np.stack([a[:, 0], np.full(POINTS, 60.0)], -1)
    for left, right in ((a, a), (line, line + 1.0), (a, _pixels(seed + 1)), (a[:3], a[:3])):
        T = relative_pose(left, right, CAMERA, CAMERA)
        if T is not None:
            check.pose("pose", T)


@case("solvers", "geometry.alignment._check")
def degenerate_alignment(check: Check, seed: int) -> None:
    """Points in one place or not finite are refused; points on a line are flagged as collinear."""
    points = _points(seed)
    broken = points.copy()
    broken[0, 0] = np.nan
    for hard in (np.ones((9, 3)), broken, points[:2]):
        check.true("it is refused", _alignment_refused(hard))
    line = points[:1] * np.linspace(1.0, 2.0, 9)[:, None]
    alignment = align(line, line, with_scale=True)
    check.pose("alignment", alignment.T_target_source)
    check.true("a line is called a line", alignment.collinear)


def _alignment_refused(
    points: Array,  # [N, 3]
) -> bool:
    try:
        align(points, points, with_scale=True)
    except InputError:
        return True
    return False


@case("solvers", "geometry.similarity._left_jacobian")
def exp_log_at_the_edges(check: Check, seed: int) -> None:
    """exp and log undo each other at 0, near 1e-8, near pi, and at scales far from 1."""
    rng = np.random.default_rng(seed)
    for angle in (0.0, 1e-300, 1e-16, 1e-8, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-8):
        axis = rng.standard_normal(3)
        w = angle * axis / np.linalg.norm(axis)
        for sigma in (0.0, 1e-8, -5.0, 5.0):
            xi = np.concatenate([rng.standard_normal(3), w, [sigma]])
            T = Sim3.exp(xi)
            check.pose(f"exp at {angle:.3g} rad", T)
            check.finite("log", T.log())
            check.below("error of log(exp)", float(np.abs(T.log() - xi).max()), 1e-6)
    half = so3_log(so3_exp(np.array([np.pi, 0.0, 0.0])))
    check.below("angle at pi", abs(float(np.linalg.norm(half)) - np.pi), 1e-12)


@case("solvers", "geometry.similarity.on_so3")
def poses_rounded_to_float32(check: Check, seed: int) -> None:
    """A pose that was stored in float32 is put back on the group by the first product."""
    R = so3_exp(np.random.default_rng(seed).standard_normal(3)).astype(np.float32)
    T = Sim3(R.astype(np.float64), np.zeros(3))
    check.pose("product", T @ Sim3.identity())
    check.pose("long product", T @ T @ T @ T @ Sim3.identity())


@case("solvers", "geometry.similarity.on_so3")
def sim3_chain(check: Check, seed: int) -> None:
    """10^4 small steps against their exact product."""
    _chain(check, seed, 10_000)


@case("solvers", "geometry.similarity.on_so3", long=True)
def sim3_chain_of_a_million(check: Check, seed: int) -> None:
    """10^6 small steps against their exact product."""
    _chain(check, seed, 1_000_000)


def _chain(check: Check, seed: int, steps: int) -> None:
    """exp(xi)^n against exp(n xi): steps along one twist commute, so the product is known."""
    rng = np.random.default_rng(seed)
    total = np.concatenate([rng.standard_normal(3), [0.9, -1.1, 0.7], [0.3]])
    step, T = Sim3.exp(total / steps), Sim3.identity()
    for _ in range(steps):
        T = step @ T
    exact = Sim3.exp(total)
    check.pose("product", T)
    bound = 1e-12 * steps**0.5
    check.below("error of R", float(np.abs(T.R - exact.R).max()), bound)
    check.below("error of t", float(np.abs(T.t - exact.t).max()), bound)
    check.below("error of scale", abs(T.scale - exact.scale), bound)
