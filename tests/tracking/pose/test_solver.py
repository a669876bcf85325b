"""The pose solver: derivatives, known answers, honest weights and covariance, degenerate inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.similarity import Sim3, so3_exp, so3_log
from aquaflow.tracking.pose import solver
from aquaflow.tracking.pose.solver import (
    UNKNOWN_SIGMA,
    PixelEquations,
    PoseProblem,
    pose_covariance,
    solve_pose,
)
from tests.tracking.tracking_scenes import CAMERA, cloud, pose, problem_of

Array = npt.NDArray[np.float64]

TRUTH = pose((0.05, -0.08, 0.1), (-0.15, 0.06, 0.1))
MONTE_CARLO = 150


def moved(T: Sim3, xi: Array) -> Sim3:
    """The solver's own update."""
    R = so3_exp(xi[3:])
    return Sim3(R @ T.R, R @ T.t + xi[:3])


def tangent(found: Sim3, truth: Sim3) -> Array:
    """[6] xi with ``found == moved(truth, xi)``."""
    R = found.R @ truth.R.T
    return np.concatenate([found.t - R @ truth.t, so3_log(R)])


def errors(found: Sim3, truth: Sim3 = TRUTH) -> tuple[float, float]:
    xi = tangent(found, truth)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))


def assert_sane(problem: PoseProblem, start: Sim3) -> None:
    """The solver gives up or gives numbers."""
    estimate = solve_pose(problem, start)
    if estimate is None:
        return
    assert estimate.T.is_finite()
    assert np.isfinite(estimate.covariance).all()
    assert 0.0 <= estimate.inlier_share <= 1.0
    assert 0.0 <= estimate.conditioning <= 1.0
    assert not np.isnan(estimate.residual_px)


@pytest.mark.parametrize("flat", [False, True], ids=["relief", "plane"])
def test_a_known_pose_is_found_exactly_without_noise(flat: bool) -> None:
    estimate = solve_pose(problem_of(cloud(1, flat=flat), TRUTH), Sim3.identity())
    assert estimate is not None
    assert max(errors(estimate.T)) < 1e-7
    assert estimate.inlier_share == 1.0
    assert estimate.residual_px < 1e-5
    assert estimate.T.scale == 1.0


@pytest.mark.parametrize("scale", [0.774, 1.3, 1e-9])
def test_the_scale_of_the_start_does_not_come_back(scale: float) -> None:
    """Of a frame that nothing measures the scale of: extrapolated, it would grow without limit."""
    problem = problem_of(cloud(1), TRUTH)
    start = Sim3(TRUTH.R, scale * TRUTH.t, scale)
    estimate = solve_pose(problem, start)
    assert estimate is not None
    assert estimate.T.scale == 1.0
    assert max(errors(estimate.T)) < 1e-7


def test_thirty_percent_outliers_do_not_move_the_pose() -> None:
    problem = problem_of(cloud(2, 600), TRUTH, noise_px=0.5)
    rng = np.random.default_rng(3)
    bad = rng.random(600) < 0.3
    problem.pixels[bad] += rng.uniform(-40, 40, (int(bad.sum()), 2))
    estimate = solve_pose(problem, Sim3.identity())
    assert estimate is not None
    shift, turn = errors(estimate.T)
    assert shift < 0.006
    assert turn < 0.005
    assert estimate.inlier_share == pytest.approx(0.7, abs=0.05)


def test_wrong_depths_with_an_honest_variance_do_little_harm() -> None:
    points = cloud(4, 400)
    rng = np.random.default_rng(5)
    rho = 1.0 / points[:, 2]
    sigma = np.where(rng.random(400) < 0.5, 0.5, 0.01) * rho
    wrong = np.maximum(rho + rng.normal(0, 1, 400) * sigma, 0.05)
    exact = problem_of(points, TRUTH, noise_px=0.3)
    seen = replace(exact, points=points / points[:, 2:] / wrong[:, None])
    start = pose((0.03, -0.06, 0.08), (-0.1, 0.04, 0.08))

    honest = solve_pose(replace(seen, rho_variance=sigma**2), start)
    blind = solve_pose(seen, start)

    assert honest is not None
    assert blind is not None
    assert errors(honest.T)[0] < 0.01
    assert errors(honest.T)[1] < 0.006
    assert sum(errors(honest.T)) < 0.5 * sum(errors(blind.T))


def test_matches_of_no_confidence_do_not_count() -> None:
    problem = problem_of(cloud(6), TRUTH)
    problem.pixels[:150] += 30.0
    problem.weights[:150] = 0.0
    estimate = solve_pose(problem, Sim3.identity())
    assert estimate is not None
    assert max(errors(estimate.T)) < 1e-6


# --- how well the pose is known -------------------------------------------------------------------


def hard(seed: int) -> PoseProblem:
    """Noise in depths and matches, and a third of the matches wrong."""
    problem = with_depth_noise(cloud(seed, 900), 0.05, seed, 0.5)
    rng = np.random.default_rng(seed)
    bad = rng.random(900) < 0.33
    problem.pixels[bad] += rng.uniform(-40, 40, (int(bad.sum()), 2))
    return problem


def with_depth_noise(points: Array, sigma: float, seed: int, noise_px: float) -> PoseProblem:
    """Independent errors of the relative size ``sigma`` in the keyframe's inverse depths."""
    rho = 1.0 / points[:, 2]
    measured = rho * (1.0 + sigma * np.random.default_rng([seed, 8]).normal(size=len(rho)))
    exact = problem_of(points, TRUTH, seed=seed, noise_px=noise_px)
    return replace(
        exact, points=points * (rho / measured)[:, None], rho_variance=(sigma * rho) ** 2
    )


def normalised_errors(problems: list[PoseProblem]) -> Array:
    """[N] squared distance of the pose from TRUTH in its stated covariance."""
    found = []
    for problem in problems:
        estimate = solve_pose(problem, TRUTH)
        assert estimate is not None
        xi = tangent(estimate.T, TRUTH)
        found.append(xi @ np.linalg.solve(estimate.covariance, xi))
    return np.array(found)


@pytest.mark.parametrize("depth_sigma", [0.0, 0.05])
def test_errors_are_as_large_as_the_covariance_says(depth_sigma: float) -> None:
    """Six degrees of freedom; the mean over the trials has a standard error of 0.3."""
    points = cloud(7, 250)
    trials = [with_depth_noise(points, depth_sigma, i, 0.5) for i in range(MONTE_CARLO)]
    mean = normalised_errors(trials).mean()
    assert 4.5 < mean < 7.2


def test_matches_that_err_together_are_not_counted_as_so_many() -> None:
    """Where neighbours err alike the plain inverse of H gives a mean of 284 instead of 6."""
    trials = [problem_of(cloud(7, 4000), TRUTH, seed=i) for i in range(60)]
    for i, problem in enumerate(trials):
        problem.pixels[:] += 0.5 * smooth_field(problem.pixels, i)
    mean = normalised_errors(trials).mean()
    assert 3.0 < mean < 30.0


def smooth_field(pixels: Array, seed: int) -> Array:
    """[M, 2] of unit variance, correlated over a 24th of the picture: a sum of random waves."""
    rng = np.random.default_rng([seed, 9])
    waves, phases = rng.normal(0, 1.0 / 10.0, (2, 60, 2)), rng.uniform(0, 2 * np.pi, (2, 60))
    total = np.cos(np.einsum("md,awd->maw", pixels, waves) + phases).sum(-1)
    return np.asarray(total * np.sqrt(2.0 / 60))


def test_a_turn_about_the_ray_that_holds_all_points_is_unknown() -> None:
    """Not zero variance, as a pseudo-inverse has it: huge, along that direction alone."""
    points = np.array([0.0, 0.0, 1.0]) * np.linspace(0.8, 3.0, 200)[:, None]
    estimate = solve_pose(problem_of(points, Sim3.identity()), Sim3.identity())
    assert estimate is not None
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert sigma[5] == pytest.approx(UNKNOWN_SIGMA, rel=1e-3)
    assert sigma[4] < 1.0
    assert estimate.degeneracy.conditioning == estimate.conditioning < 1e-9


def test_a_free_scale_that_nothing_measures_is_the_weakest_direction() -> None:
    estimate = solve_pose(problem_of(cloud(3), TRUTH, noise_px=0.5), TRUTH, free_scale=True)
    assert estimate is not None
    assert estimate.degeneracy.kind == "scale"
    assert estimate.degeneracy.weakest_sigma == UNKNOWN_SIGMA
    assert abs(estimate.degeneracy.weakest[6]) == pytest.approx(1.0)
    assert estimate.T.scale == pytest.approx(1.0)


@pytest.mark.parametrize(("axis", "kind"), [(1, "translation"), (4, "rotation")])
def test_the_weakest_direction_is_named(axis: int, kind: str) -> None:
    information = np.full(6, 100.0)
    information[axis] = 0.0
    unit = np.array([0.5, 0.5, 0.5, 1.0, 1.0, 1.0])
    H = np.diag(information / unit**2)
    covariance, report = pose_covariance(H, np.zeros((6, 4)), TRUTH, 0.5)
    assert report.kind == kind
    assert abs(report.weakest[axis]) == pytest.approx(1.0)
    np.testing.assert_allclose(report.eigenvalues, [0.0, *[100.0] * 5])
    assert covariance[axis, axis] == pytest.approx((unit[axis] * UNKNOWN_SIGMA) ** 2)


def test_the_report_does_not_depend_on_the_unit_of_length() -> None:
    small = problem_of(cloud(3), TRUTH, noise_px=0.5)
    large = replace(small, points=50.0 * small.points)
    one, other = solve_pose(small, TRUTH), solve_pose(large, Sim3(TRUTH.R, 50.0 * TRUTH.t))
    assert one is not None
    assert other is not None
    assert other.conditioning == pytest.approx(one.conditioning, rel=1e-2)
    np.testing.assert_allclose(other.degeneracy.eigenvalues, one.degeneracy.eigenvalues, rtol=1e-2)
    ratio = np.sqrt(np.diag(other.covariance) / np.diag(one.covariance))
    np.testing.assert_allclose(ratio, [50.0] * 3 + [1.0] * 3, rtol=1e-2)


@pytest.mark.parametrize("far", [False, True], ids=["pure rotation", "scene at infinity"])
def test_a_baseline_that_may_be_none_is_told_from_one(far: bool) -> None:
    points = cloud(9, 1000) * (1e6 if far else 1.0)
    turned = pose((0.1, -0.1, 0.2), (0.1 if far else 0.0, 0.0, 0.0))
    nothing = solve_pose(problem_of(points, turned, noise_px=0.5), turned)
    swum = solve_pose(problem_of(cloud(9, 1000), TRUTH, noise_px=0.5), TRUTH)
    assert nothing is not None
    assert swum is not None
    assert nothing.degeneracy.baseline_sigmas < 4.5
    assert swum.degeneracy.baseline_sigmas > 50.0


# --- degenerate inputs ----------------------------------------------------------------------------


def test_a_pure_rotation_is_solved() -> None:
    turned = pose((0.1, -0.1, 0.2), (0.0, 0.0, 0.0))
    estimate = solve_pose(problem_of(cloud(9), turned), Sim3.identity())
    assert estimate is not None
    assert max(errors(estimate.T, turned)) < 1e-7


def test_standing_still_is_solved_though_depth_errors_have_no_direction() -> None:
    problem = problem_of(cloud(10), Sim3.identity())
    problem.points[0] = [0.0, 0.0, 1.0]
    problem.pixels[0] = [CAMERA.cx, CAMERA.cy]
    estimate = solve_pose(replace(problem, rho_variance=np.full(300, 0.1)), Sim3.identity())
    assert estimate is not None
    assert max(errors(estimate.T, Sim3.identity())) < 1e-9


def test_one_point_repeated_is_reported_as_degenerate() -> None:
    points = np.repeat(cloud(11, 1), 100, axis=0)
    problem = problem_of(points, TRUTH, noise_px=0.5)
    assert_sane(problem, Sim3.identity())
    estimate = solve_pose(problem, Sim3.identity())
    assert estimate is None or estimate.conditioning < 1e-9


def test_relief_is_better_conditioned_than_a_small_patch() -> None:
    wide = solve_pose(problem_of(cloud(12), TRUTH), TRUTH)
    points = cloud(12)
    patch = points[(np.abs(points[:, :2] / points[:, 2:]) < 0.08).all(1)]
    narrow = solve_pose(problem_of(patch, TRUTH), TRUTH)
    assert wide is not None
    assert narrow is not None
    assert 0.0 < narrow.conditioning < 0.5 * wide.conditioning


@pytest.mark.parametrize("field", ["points", "pixels", "rho_variance", "weights"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_none_never_come_out(field: str, value: float) -> None:
    problem = problem_of(cloud(13), TRUTH)
    getattr(problem, field)[5] = value
    with np.errstate(all="ignore"):
        assert_sane(problem, Sim3.identity())


def test_points_behind_or_inside_the_camera_raise_nothing() -> None:
    points = cloud(14)
    points[:100, 2] *= -1.0
    points[100:120] = 0.0
    assert_sane(problem_of(points, TRUTH, noise_px=0.5), Sim3.identity())


def test_points_behind_the_camera_are_no_inliers() -> None:
    problem = problem_of(cloud(15), TRUTH)
    problem.points[:90] *= -1.0
    estimate = solve_pose(problem, TRUTH)
    assert estimate is None or estimate.inlier_share <= 0.7


def test_a_start_that_sees_nothing_raises_nothing() -> None:
    problem = problem_of(cloud(16), TRUTH)
    assert_sane(problem, pose((0.0, np.pi, 0.0), (0.0, 0.0, -50.0)))


def test_no_matches_are_no_pose() -> None:
    assert solve_pose(problem_of(np.zeros((0, 3)), TRUTH), Sim3.identity()) is None


def test_random_matches_raise_nothing() -> None:
    rng = np.random.default_rng(0)
    problem = problem_of(cloud(17), TRUTH)
    problem.pixels[:] = rng.uniform(0, 240, problem.pixels.shape)
    assert_sane(problem, Sim3.identity())
    estimate = solve_pose(problem, Sim3.identity())
    assert estimate is None or estimate.inlier_share < 0.3


def counted(monkeypatch: pytest.MonkeyPatch) -> list[Sim3]:
    """The poses at which the solver linearises from now on."""
    taken: list[Sim3] = []
    linearise = solver.PixelEquations.at

    def count(equations: PixelEquations, T: Sim3) -> tuple[Array, Array, float]:
        taken.append(T)
        return linearise(equations, T)

    monkeypatch.setattr(solver.PixelEquations, "at", count)
    return taken


def test_a_solver_that_may_not_stop_takes_its_last_step_to_the_same_pose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, taken = problem_of(cloud(3), TRUTH, noise_px=0.3), counted(monkeypatch)
    early = solve_pose(problem, Sim3.identity())
    stopped_after = len(taken)
    late = solve_pose(problem, Sim3.identity(), stop_converged=False)
    assert stopped_after < solver.RULES.iterations
    assert len(taken) - stopped_after == solver.RULES.iterations + 1
    assert early is not None
    assert late is not None
    assert max(errors(late.T, early.T)) < 1e-4


def test_the_solver_stops_where_little_is_left_to_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise in matches and depths, a third outliers: few linearisations, a twentieth of sigma."""
    for seed in range(6):
        problem = hard(seed)
        taken = counted(monkeypatch)
        early = solve_pose(problem, moved(TRUTH, np.full(6, 0.01)))
        assert len(taken) <= 9
        assert early is not None
        late = solve_pose(problem, early.T, stop_converged=False)
        assert late is not None
        left = tangent(early.T, late.T)
        assert np.sqrt(left @ np.linalg.solve(early.covariance, left)) < 0.06
        monkeypatch.undo()
