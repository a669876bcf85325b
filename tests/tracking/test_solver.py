"""The pose solver: derivatives, known answers, honest weights and covariance, degenerate inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tracking_scenes import CAMERA, cloud, pose, problem_of

from aquaflow.geometry.similarity import Sim3, so3_exp, so3_log
from aquaflow.tracking import solver
from aquaflow.tracking.solver import PoseProblem, solve_pose

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


@pytest.mark.parametrize("depth_sigma", [0.0, 0.1])
def test_jacobians_agree_with_finite_differences(depth_sigma: float) -> None:
    """At zero residual the whitening does not matter, so all of J is compared."""
    problem = problem_of(cloud(0, 40), TRUTH)
    problem = replace(problem, rho_variance=np.full(40, depth_sigma**2))
    _, J = solver._linearise(problem, TRUTH)
    step = 1e-6
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = step
        ahead, _ = solver._linearise(problem, moved(TRUTH, xi))
        behind, _ = solver._linearise(problem, moved(TRUTH, -xi))
        numeric = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(J[..., k], numeric, rtol=1e-5, atol=1e-4)


def test_the_normal_equations_are_the_gradient_of_the_cost() -> None:
    """With exact depths the whitening is a constant rotation, so the gradient is exact too."""
    problem = problem_of(cloud(0, 40), TRUTH, noise_px=3.0)
    start = moved(TRUTH, np.full(6, 1e-3))
    residual, J = solver._linearise(problem, start)
    _, g = solver._normal_equations(residual, J, problem.weights)

    def squared(T: Sim3) -> float:
        found, _ = solver._linearise(problem, T)
        return float(0.5 * (found**2).sum())

    numeric = [
        (squared(moved(start, xi)) - squared(moved(start, -xi))) / 2e-6 for xi in 1e-6 * np.eye(6)
    ]
    plain = J.reshape(-1, 6).T @ residual.reshape(-1)
    np.testing.assert_allclose(plain, numeric, rtol=1e-4)
    assert np.linalg.norm(g) < np.linalg.norm(plain)


@pytest.mark.parametrize("flat", [False, True], ids=["relief", "plane"])
def test_a_known_pose_is_found_exactly_without_noise(flat: bool) -> None:
    estimate = solve_pose(problem_of(cloud(1, flat=flat), TRUTH), Sim3.identity())
    assert estimate is not None
    assert max(errors(estimate.T)) < 1e-7
    assert estimate.inlier_share == 1.0
    assert estimate.residual_px < 1e-5
    assert estimate.T.scale == 1.0


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


@pytest.mark.parametrize("depth_sigma", [0.0, 0.05])
def test_the_covariance_is_the_spread_under_noise(depth_sigma: float) -> None:
    points = cloud(7, 150)
    rho = 1.0 / points[:, 2]
    variance = (depth_sigma * rho) ** 2
    rng = np.random.default_rng(8)
    found, stated = [], []
    for trial in range(MONTE_CARLO):
        problem = problem_of(points, TRUTH, seed=trial, noise_px=0.5)
        noisy = rho + rng.normal(0, 1, len(rho)) * np.sqrt(variance)
        problem = replace(problem, points=points * (rho / noisy)[:, None], rho_variance=variance)
        estimate = solve_pose(problem, TRUTH)
        assert estimate is not None
        found.append(tangent(estimate.T, TRUTH))
        stated.append(np.diag(estimate.covariance))
    ratio = np.std(found, axis=0) / np.sqrt(np.mean(stated, axis=0))
    assert (ratio > 1.0 / 1.5).all()
    assert (ratio < 1.5).all()


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


def test_a_solver_that_may_not_stop_takes_its_last_step_to_the_same_pose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, taken = problem_of(cloud(3), TRUTH, noise_px=0.3), []
    linearise = solver._linearise

    def counted(problem: PoseProblem, T: Sim3) -> tuple[Array, Array]:
        taken.append(T)
        return linearise(problem, T)

    monkeypatch.setattr(solver, "_linearise", counted)
    early = solve_pose(problem, Sim3.identity())
    stopped_after = len(taken)
    late = solve_pose(problem, Sim3.identity(), stop_converged=False)
    assert stopped_after < solver.MAX_ITERATIONS
    assert len(taken) - stopped_after == solver.MAX_ITERATIONS + 1
    assert early is not None
    assert late is not None
    assert max(errors(late.T, early.T)) < 1e-4
