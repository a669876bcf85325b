"""Bundle adjustment: derivatives, the known answer with and without focal, degenerate inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp, so3_log
from aquaflow.tracking.initialisation import bundle as module
from aquaflow.tracking.initialisation.bundle import Bundle, BundleResult, adjust
from tests.tracking.tracking_scenes import CAMERA, cloud, pose

Array = npt.NDArray[np.float64]

VIEWS = [
    pose((0.02, -0.06, 0.05), (-0.25, 0.05, 0.05)),
    pose((-0.05, 0.08, -0.1), (0.15, -0.2, 0.1)),
    pose((0.1, 0.02, 0.3), (0.1, 0.2, -0.2)),
]


def truth(seed: int = 0, count: int = 200, camera: CameraModel = CAMERA) -> tuple[Array, Bundle]:
    """Reference pixels [P, 2] and the scene, scaled to a median inverse depth of 1."""
    points = cloud(seed, count)
    pixels = CAMERA.project(points)
    rho = 1.0 / points[:, 2]
    scale = float(np.median(rho))
    return pixels, Bundle([Sim3(T.R, T.t * scale) for T in VIEWS], rho / scale, camera)


def observations(pixels: Array, scene: Bundle, noise_px: float = 0.0, seed: int = 0) -> Array:
    rays = scene.camera.unproject(pixels)
    exact = np.stack(
        [scene.camera.project(rays @ T.R.T + scene.rho[:, None] * T.t) for T in scene.T]
    )
    return exact + np.random.default_rng(seed).normal(0, 1, exact.shape) * noise_px


def disturbed(scene: Bundle, seed: int = 1, focal: float = 1.0) -> Bundle:
    rng = np.random.default_rng(seed)
    views = [
        Sim3(so3_exp(rng.normal(0, 0.01, 3)) @ T.R, T.t + rng.normal(0, 0.02, 3)) for T in scene.T
    ]
    rho = scene.rho * np.exp(rng.normal(0, 0.1, len(scene.rho)))
    return Bundle(views, rho, scene.camera.with_focal_scaled(focal))


def solved(
    noise_px: float = 0.0, focal: float | None = None, seed: int = 0
) -> tuple[BundleResult, Bundle]:
    pixels, scene = truth()
    seen = observations(pixels, scene, noise_px, seed)
    start = disturbed(scene, focal=focal or 1.0)
    everywhere = np.ones(seen.shape[:2], bool)
    return adjust(pixels, seen, everywhere, start, solve_focal=focal is not None), scene


def assert_finite(result: BundleResult) -> None:
    assert np.isfinite(result.bundle.rho).all()
    assert all(T.is_finite() for T in result.bundle.T)
    assert not np.isnan(result.residual_px)
    assert not np.isnan(result.focal_sigma)
    assert np.isfinite(result.rho_sigma).all()


@pytest.mark.parametrize("view", range(3))
def test_jacobians_agree_with_finite_differences_focal_included(view: int) -> None:
    pixels, scene = truth(count=30)
    seen = observations(pixels, scene, 0.5)
    system = module._System(pixels, seen, np.ones(seen.shape[:2], bool), solve_focal=True)
    _, Y, rays = system.residuals(scene)
    Jc, Jp = system._jacobians(scene, view, Y[view], rays)

    def error(xi: Array, drho: float, log_f: float) -> Array:
        T, R = scene.T[view], so3_exp(xi[3:])
        views = list(scene.T)
        views[view] = Sim3(R @ T.R, R @ T.t + xi[:3])
        camera = scene.camera.with_focal_scaled(float(np.exp(log_f)))
        return system.residuals(Bundle(views, scene.rho + drho, camera))[0][view]

    h, zero = 1e-6, np.zeros(6)
    for k in range(6):
        xi = h * np.eye(6)[k]
        numeric = (error(xi, 0, 0) - error(-xi, 0, 0)) / (2 * h)
        np.testing.assert_allclose(Jc[k].T, numeric, rtol=1e-5, atol=1e-4)
    numeric = (error(zero, h, 0) - error(zero, -h, 0)) / (2 * h)
    np.testing.assert_allclose(Jp.T, numeric, rtol=1e-5, atol=1e-4)
    numeric = (error(zero, 0, h) - error(zero, 0, -h)) / (2 * h)
    np.testing.assert_allclose(Jc[6].T, numeric, rtol=1e-5, atol=1e-4)


def test_poses_and_depths_are_recovered_exactly_without_noise() -> None:
    result, scene = solved()
    np.testing.assert_allclose(result.bundle.rho, scene.rho, rtol=1e-4)
    for found, true in zip(result.bundle.T, scene.T, strict=True):
        np.testing.assert_allclose(found.t, true.t, atol=1e-4)
        np.testing.assert_allclose(found.R, true.R, atol=1e-4)
    assert result.focal_sigma == 0.0
    assert result.bundle.camera == scene.camera


@pytest.mark.parametrize("factor", [0.75, 1.3])
def test_the_focal_length_is_recovered(factor: float) -> None:
    result, scene = solved(noise_px=0.2, focal=factor)
    camera = result.bundle.camera
    assert camera.fx == pytest.approx(CAMERA.fx, rel=0.02)
    assert camera.fy / camera.fx == pytest.approx(CAMERA.fy / CAMERA.fx)
    assert abs(camera.fx / CAMERA.fx - 1.0) < 4.0 * result.focal_sigma
    assert np.median(np.abs(result.bundle.rho / scene.rho - 1.0)) < 0.02


def test_the_stated_focal_sigma_is_the_spread_under_noise() -> None:
    results = [solved(noise_px=0.3, focal=1.05, seed=seed)[0] for seed in range(16)]
    spread = np.std([np.log(result.bundle.camera.fx) for result in results])
    stated = np.mean([result.focal_sigma for result in results])
    assert 0.4 < spread / stated < 1.6


def test_the_stated_depth_sigma_bounds_the_error_under_noise() -> None:
    """The sigma holds the poses fixed, so it may be a little short, never by much."""
    result, scene = solved(noise_px=0.3)
    z = (result.bundle.rho - scene.rho) / result.rho_sigma
    assert 0.4 < np.std(z) < 1.6


def test_the_answer_has_median_inverse_depth_one_whatever_the_start_scale() -> None:
    pixels, scene = truth()
    seen = observations(pixels, scene)
    grown = Bundle([Sim3(T.R, 7.0 * T.t) for T in scene.T], scene.rho / 7.0, scene.camera)
    result = adjust(pixels, seen, np.ones(seen.shape[:2], bool), grown)
    assert np.median(result.bundle.rho) == pytest.approx(1.0)
    np.testing.assert_allclose(result.bundle.T[0].t, scene.T[0].t, atol=1e-6)


def test_matches_of_little_weight_bend_the_geometry_little() -> None:
    pixels, scene = truth()
    seen = observations(pixels, scene)
    unsure = np.random.default_rng(6).random(seen.shape[:2]) < 0.4
    seen[unsure] += 0.7 * np.sign(pixels[:, 0] - CAMERA.cx)[np.nonzero(unsure)[1], None]
    errors = []
    for weight in (1.0, 0.02):
        result = adjust(pixels, seen, np.where(unsure, weight, 1.0), disturbed(scene))
        turns = [so3_log(f.R @ t.R.T) for f, t in zip(result.bundle.T, scene.T, strict=True)]
        errors.append(float(np.max(np.abs(turns))))
    assert errors[1] < 0.1 * errors[0]


def test_outliers_and_missing_observations_do_little_harm() -> None:
    pixels, scene = truth()
    seen = observations(pixels, scene, 0.2)
    rng = np.random.default_rng(5)
    bad = rng.random(seen.shape[:2]) < 0.1
    seen[bad] += rng.uniform(-30, 30, (int(bad.sum()), 2))
    observed = rng.random(seen.shape[:2]) < 0.8
    seen[~observed] = -1e4
    result = adjust(pixels, seen, observed, disturbed(scene))
    turns = [so3_log(f.R @ t.R.T) for f, t in zip(result.bundle.T, scene.T, strict=True)]
    assert np.max(np.abs(turns)) < 0.01
    assert np.median(np.abs(result.bundle.rho / scene.rho - 1.0)) < 0.03


def test_the_cost_counts_points_behind_a_view_that_sees_them() -> None:
    pixels, scene = truth()
    seen = observations(pixels, scene)
    system = module._System(pixels, seen, np.ones(seen.shape[:2], bool), solve_focal=False)
    turned = Bundle([pose((0.0, np.pi, 0.0), (0.0, 0.0, 0.0)), *scene.T[1:]], *scene_rest(scene))
    assert system.cost(scene) == pytest.approx(0.0, abs=1e-12)
    assert system.cost(turned) == pytest.approx(10.0 * module.HUBER_PX * len(pixels))


def scene_rest(scene: Bundle) -> tuple[Array, CameraModel]:
    return scene.rho, scene.camera


def test_inverse_depths_stay_above_their_floor() -> None:
    pixels, scene = truth()
    far = replace(scene, rho=np.where(np.arange(len(scene.rho)) < 20, 1e-9, scene.rho))
    seen = observations(pixels, far, 0.5)
    result = adjust(pixels, seen, np.ones(seen.shape[:2], bool), disturbed(scene))
    assert_finite(result)
    assert result.bundle.rho.min() > 0.0
    assert np.median(result.bundle.rho[:20]) < 0.05


@pytest.mark.parametrize("solve_focal", [False, True])
def test_views_that_did_not_move_raise_nothing(solve_focal: bool) -> None:
    pixels, scene = truth()
    still = replace(scene, T=[Sim3.identity()] * 3)
    seen = observations(pixels, still)
    result = adjust(pixels, seen, np.ones(seen.shape[:2], bool), still, solve_focal)
    assert_finite(result)


@pytest.mark.parametrize("solve_focal", [False, True])
def test_nothing_observed_is_an_infinite_residual(solve_focal: bool) -> None:
    pixels, scene = truth()
    seen = observations(pixels, scene)
    result = adjust(pixels, seen, np.zeros(seen.shape[:2], bool), scene, solve_focal)
    assert result.residual_px == np.inf
    assert np.isfinite(result.bundle.rho).all()


@pytest.mark.parametrize("solve_focal", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_match_that_is_no_number_costs_only_itself(value: float, solve_focal: bool) -> None:
    pixels, scene = truth()
    seen = observations(pixels, scene)
    seen[1, 3] = value
    result = adjust(pixels, seen, np.ones(seen.shape[:2], bool), disturbed(scene), solve_focal)
    assert_finite(result)
    np.testing.assert_allclose(result.bundle.rho, scene.rho, rtol=1e-3)
