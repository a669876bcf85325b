"""Each factor: no residual at the truth of a dive without noise, and true derivatives."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.factors import (
    DepthFactor,
    Factor,
    ForceFactor,
    HeadingFactor,
    PositionFactor,
    TiltFactor,
    VelocityFactor,
    axes_along,
)
from aquaflow.telemetry.state import CLOCK, LAG, SCALE, MetricState, P
from aquaflow.telemetry.telemetry import Series
from tests.telemetry.exact_scene import ExactScene, disturbed

Array = npt.NDArray[np.float64]

SEEDS = st.integers(0, 2**31)
STENCIL = 1e-3
"""Of a five-point stencil, whose error is of its fourth power; the factors' own step is 1e-6."""
EXACT = {"velocity": 1e-6}
"""m, by which a spline through 50 samples a second errs; all else is exact but for rounding."""


def every(scene: ExactScene) -> list[Factor]:
    return [*scene.factors(), *([scene.altitude()] if scene.flat else [])]


def full_jacobian(factor: Factor, state: MetricState) -> Array:
    """[N, D, P] by the five-point stencil, of every parameter."""
    columns = []
    for k in range(P):
        step = np.zeros(P)
        step[k] = STENCIL
        one, two = (
            factor.residuals(state.move(n * step)) - factor.residuals(state.move(-n * step))
            for n in (1, 2)
        )
        columns.append((8.0 * one - two) / (12.0 * STENCIL))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("flat", [False, True])
@settings(max_examples=4)
@given(seed=SEEDS)
def test_residuals_are_zero_at_the_truth(flat: bool, seed: int) -> None:
    scene = ExactScene.drawn(seed, flat)
    factors = every(scene)
    assert len(factors) == (10 if flat else 8)
    for factor in factors:
        assert len(factor.t_s)
        np.testing.assert_allclose(
            factor.residuals(scene.state), 0.0, atol=EXACT.get(factor.kind, 1e-8),
            err_msg=factor.kind,
        )  # fmt: skip


@pytest.mark.parametrize("flat", [False, True])
@settings(max_examples=3)
@given(seed=SEEDS)
def test_derivatives_are_true_and_no_parameter_is_forgotten(flat: bool, seed: int) -> None:
    scene = ExactScene.drawn(seed, flat)
    state = disturbed(scene.state, seed, 0.05)
    for factor in every(scene):
        expected, found = full_jacobian(factor, state), factor.jacobian(state)
        np.testing.assert_allclose(found, expected, atol=1e-5, err_msg=factor.kind)
        spanned = np.zeros(P, dtype=bool)
        for span in factor.spans:
            spanned[span] = True
        assert np.abs(expected[..., ~spanned]).max() < 1e-9, factor.kind
        assert np.abs(expected[..., spanned]).max() > 1e-3, factor.kind


@given(seed=SEEDS)
@settings(max_examples=4)
def test_the_turn_that_is_wanted_levels_the_body(seed: int) -> None:
    scene = ExactScene.drawn(seed)
    tilt = next(f for f in scene.factors() if type(f) is TiltFactor)
    state = disturbed(scene.state, seed, 0.01)
    turned = Rotation.from_rotvec(tilt.turn_wanted(state)).as_matrix()
    path = scene.path.at(tilt.t_s)
    R_nb = turned @ state.body(*path)[0]
    off = np.linalg.norm(np.cross(R_nb[:, 2, :], tilt.down_b), axis=1)
    assert off.max() < 1e-3  # second order of the 0.01 to 0.03 rad that it was off
    before = np.linalg.norm(tilt.residuals(state), axis=1)
    assert off.max() < 0.1 * before.max()


def test_a_fix_that_is_older_than_it_says_shows_as_lag() -> None:
    t = np.arange(0.0, 20.0)
    way = np.column_stack([0.5 * t, 0.2 * t, np.zeros_like(t)])
    path = CameraPath(t, np.tile(np.eye(3), (len(t), 1, 1)), way)
    state = MetricState(0.0, np.eye(3), np.zeros(3), np.eye(3), np.zeros(3), np.eye(3))
    fixes = way[5:15, :2] - 0.8 * np.array([0.5, 0.2])
    factor = PositionFactor("usbl", t[5:15], fixes, np.full(10, 0.1), path)
    step = np.zeros(P)
    step[LAG] = 0.8
    np.testing.assert_allclose(factor.residuals(state.move(step)), 0.0, atol=1e-12)


def test_a_depth_and_a_dvl_of_a_clock_that_is_late_and_slow_show_it() -> None:
    t = np.arange(0.0, 20.0, 0.1)
    v = np.array([0.5, 0.2, 0.1])
    path = CameraPath(t, np.tile(np.eye(3), (len(t), 1, 1)), t[:, None] * v)
    state = MetricState(0.0, np.eye(3), np.zeros(3), np.eye(3), np.zeros(3), np.eye(3))
    true_s = t - (0.3 + 0.05 * (t - path.middle_s))
    depth = Series("bar30", t, v[2] * true_s[:, None])
    dvl = Series("dvl", t, np.tile([*(0.95 * v), 0.01], (len(t), 1)))
    step = np.zeros(P)
    step[CLOCK] = 0.3, 0.05
    for factor in (DepthFactor(depth, path), VelocityFactor(dvl, path)):
        np.testing.assert_allclose(factor.residuals(state.move(step)), 0.0, atol=1e-12)


def test_the_scale_that_each_displacement_wants_is_the_true_one() -> None:
    scene = ExactScene.drawn(3)
    velocity = next(f for f in scene.factors() if isinstance(f, VelocityFactor))
    step = np.zeros(P)
    step[SCALE] = -0.02
    misfit, sigma = velocity.scale_misfit(scene.state.move(step))
    np.testing.assert_allclose(misfit, 0.02, rtol=0.05)
    assert (sigma > 0.0).all()


@pytest.mark.parametrize("loop_s", [4.0, 1.6])
def test_a_dvl_of_five_samples_a_second_does_not_cut_the_corners_of_a_loop(loop_s: float) -> None:
    t = np.arange(0.0, 2.0 * loop_s, 0.1)
    w = 2.0 * np.pi / loop_s
    way = 0.6 / w * np.column_stack([np.cos(w * t), np.sin(w * t), 0.3 * np.sin(w * t)])
    path = CameraPath(t, np.tile(np.eye(3), (len(t), 1, 1)), way)
    at = np.arange(0.13, t[-1], 0.2)  # between two poses
    v = 0.6 * np.column_stack([-np.sin(w * at), np.cos(w * at), 0.3 * np.cos(w * at)])
    dvl = Series("dvl", at, np.column_stack([v, 0.01 + 0.0 * at]))
    state = MetricState(0.0, np.eye(3), np.zeros(3), np.eye(3), np.zeros(3), np.eye(3))
    misfit, _ = VelocityFactor(dvl, path).scale_misfit(state)
    assert np.abs(misfit).max() < 0.01 * (w * 0.2) ** 2  # the trapezoidal rule: 0.08


def test_waves_are_felt_near_the_surface_and_not_in_the_deep() -> None:
    t = np.arange(0.0, 4.0, 0.1)
    path = CameraPath(t, np.tile(np.eye(3), (len(t), 1, 1)), np.zeros((len(t), 3)))
    waves = [
        DepthFactor(Series("bar30", t, np.full((len(t), 1), depth_m)), path).slow.waves
        for depth_m in (0.0, 10.0, 40.0)
    ]
    np.testing.assert_allclose(waves, [0.106, 0.106 * np.exp(-2.515), 0.0], rtol=0.01, atol=1e-4)


def test_the_scale_that_each_altitude_wants_is_the_true_one() -> None:
    scene = ExactScene.drawn(3, flat=True)
    step = np.zeros(P)
    step[SCALE] = -0.02
    misfit, sigma = scene.altitude().scale_misfit(scene.state.move(step))
    np.testing.assert_allclose(misfit, 0.02, rtol=0.05)
    assert (sigma > 0.0).all()
    assert scene.altitude().rough_log_scale == pytest.approx(scene.state.log_scale)


def test_an_error_of_the_scale_keeps_its_sign_when_the_vehicle_turns_round() -> None:
    t = np.arange(0.0, 40.0, 0.2)
    x = np.abs(20.0 - t)  # one lane ahead, one back
    way = np.column_stack([x, 0.0 * t, 0.0 * t])
    path = CameraPath(t, np.tile(np.eye(3), (len(t), 1, 1)), way)
    v = np.gradient(x, t)
    series = Series("dvl", t, np.column_stack([v, 0.0 * t, 0.0 * t, 0.01 + 0.0 * t]))
    state = MetricState(0.01, np.eye(3), np.zeros(3), np.eye(3), np.zeros(3), np.eye(3))
    along = VelocityFactor(series, path).residuals(state)[:, 0]
    apart_from_the_turn = np.delete(along, [len(along) // 2 - 1, len(along) // 2])
    assert (apart_from_the_turn > 0.005).all()


def test_a_force_that_is_no_gravity_gives_no_direction() -> None:
    scene = ExactScene.drawn(1)
    blows = Series("imu", scene.t_s, np.tile([0.0, 0.0, -25.0], (len(scene.t_s), 1)))
    assert ForceFactor.of_force(blows, scene.path) is None


def test_a_compass_is_compared_across_the_turn_of_360_degrees() -> None:
    scene = ExactScene.drawn(2)
    heading = next(f for f in scene.factors() if isinstance(f, HeadingFactor))
    step = np.zeros(P)
    step[14] = 2.0 * np.pi
    np.testing.assert_allclose(heading.residuals(scene.state.move(step)), 0.0, atol=1e-8)


def test_axes_are_orthonormal_with_the_first_along_the_vector() -> None:
    vectors = np.array([[2.0, 0.0, 0.0], [0.0, -3.0, 0.1], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    axes = axes_along(vectors)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, 1, 2), np.tile(np.eye(3), (4, 1, 1)),
                               atol=1e-12)  # fmt: skip
    lengths = np.linalg.norm(vectors, axis=1)
    np.testing.assert_allclose(axes[:, 0] * lengths[:, None], vectors, atol=1e-12)
