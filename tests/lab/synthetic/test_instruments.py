"""Each error of depth cell and inertial sensors has the stated size, on series of an hour."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.telemetry.measurement import (
    acceleration,
    angular_rate,
    attitude,
    depth,
    tide,
    velocity,
    wave,
)
from aquaflow.lab.synthetic.telemetry.series import Constants
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise
from tests.lab.synthetic.an_hour import constants_of, motion_of_an_hour, only, times

Array = npt.NDArray[np.float64]
Rng = np.random.Generator


@pytest.fixture(scope="module")
def motion() -> TrueBodyMotion:
    return motion_of_an_hour()


def correlation(series: Array, lag: int) -> float:
    return float((series[lag:] * series[:-lag]).mean() / series.var())


Instrument = Callable[[Array, TrueBodyMotion, Constants, TelemetryNoise, Rng], Array]


def error_of(
    instrument: Instrument, motion: TrueBodyMotion, hz: float, noise: TelemetryNoise
) -> tuple[Array, Array]:
    """Times [N] and measurement minus truth [N, K]."""
    t, constants = times(hz), constants_of(noise)
    true = instrument(t, motion, constants_of(only()), only(), np.random.default_rng(1))
    return t, instrument(t, motion, constants, noise, np.random.default_rng(1)) - true


def test_without_errors_every_instrument_measures_the_truth(motion: TrueBodyMotion) -> None:
    t, rng = np.linspace(10.0, 20.0, 50), np.random.default_rng(0)
    known = (motion, constants_of(only()), only(), rng)
    np.testing.assert_allclose(depth(t, *known)[:, 0], motion.origin_w(t)[:, 2])
    np.testing.assert_allclose(angular_rate(t, *known), motion.rate_b(t))
    np.testing.assert_allclose(acceleration(t, *known), motion.force_b(t))
    np.testing.assert_allclose(velocity(t, *known)[:, :3], motion.velocity_b(t))
    measured = Rotation.from_quat(np.roll(attitude(t, *known), -1, axis=1))
    np.testing.assert_allclose(measured.as_matrix(), motion.R_wb(t), atol=1e-12)


def test_depth_noise_is_white_and_comes_in_steps(motion: TrueBodyMotion) -> None:
    _, white = error_of(depth, motion, 5.0, only(depth_sigma_m=0.01))
    assert white.std() == pytest.approx(0.01, rel=0.03)
    assert abs(correlation(white[:, 0], 1)) < 0.05
    noise = only(depth_resolution_m=0.002)
    steps = depth(times(1.0), motion, constants_of(noise), noise, np.random.default_rng(0)) / 0.002
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert len(np.unique(np.round(steps))) > 100


def test_depth_keeps_its_offset_and_rises_with_the_tide(motion: TrueBodyMotion) -> None:
    noise = only(depth_offset_sigma_m=0.1, tide_amplitude_m=1.5)
    t, error = error_of(depth, motion, 1.0, noise)
    constants = constants_of(noise)
    assert error[0, 0] == pytest.approx(constants.depth_offset_m)
    np.testing.assert_allclose(error[:, 0] - error[0, 0], tide(t, constants, noise), atol=1e-9)
    half = np.linspace(0.0, noise.tide_period_s, 1000)
    assert np.ptp(tide(half, constants, noise)) == pytest.approx(3.0, rel=1e-3)
    # An hour of tide is at most a quarter of its range in a twelfth of its period.
    assert 0.0 < np.ptp(error) < 0.8


def test_wave_pressure_has_its_period_and_fades_with_depth(motion: TrueBodyMotion) -> None:
    noise = only(wave_height_m=0.5, wave_period_s=6.0)
    constants = constants_of(noise)
    t = np.linspace(0.0, 60.0, 6001)
    k = (2.0 * np.pi / 6.0) ** 2 / 9.80665
    for at in (0.0, 3.0, 12.0):
        felt = wave(t, np.full(len(t), at), constants, noise)
        assert np.ptp(felt) == pytest.approx(0.5 * np.exp(-k * at), rel=1e-3)
        np.testing.assert_allclose(felt[600:], felt[:-600], atol=1e-9)
    _, error = error_of(depth, motion, 2.0, noise)
    assert error.std() == pytest.approx(0.25 / np.sqrt(2) * np.exp(-k * 10.5), rel=0.15)


def turn_of(motion: TrueBodyMotion, noise: TelemetryNoise, hz: float = 2.0) -> tuple[Array, Array]:
    """[N, 3] degrees: attitude errors about the body's axes, and about the world's."""
    t = times(hz)
    measured = attitude(t, motion, constants_of(noise), noise, np.random.default_rng(2))
    R = Rotation.from_quat(np.roll(measured, -1, axis=1))
    true = Rotation.from_matrix(motion.R_wb(t))
    return (true.inv() * R).as_rotvec(degrees=True), (R * true.inv()).as_rotvec(degrees=True)


def test_attitude_noise_is_white_about_each_axis(motion: TrueBodyMotion) -> None:
    error, _ = turn_of(motion, only(attitude_sigma_deg=0.4))
    np.testing.assert_allclose(error.std(axis=0), 0.4, rtol=0.05)
    assert abs(correlation(error[:, 0], 1)) < 0.05


def test_roll_and_pitch_wander_and_heading_does_not_with_them(motion: TrueBodyMotion) -> None:
    error, _ = turn_of(motion, only(tilt_wander_sigma_deg=0.5, tilt_wander_s=5.0))
    np.testing.assert_allclose(error[:, :2].std(axis=0), 0.5, rtol=0.15)
    for axis in (0, 1):
        assert correlation(error[:, axis], 10) == pytest.approx(np.exp(-1.0), abs=0.12)
    np.testing.assert_allclose(error[:, 2], 0.0, atol=1e-9)


def test_compass_has_an_offset_and_a_wandering_disturbance(motion: TrueBodyMotion) -> None:
    noise = only(heading_offset_sigma_deg=4.0, heading_wander_sigma_deg=2.0, heading_wander_s=5.0)
    _, error = turn_of(motion, noise)
    np.testing.assert_allclose(error[:, :2], 0.0, atol=1e-9)
    assert error[:, 2].mean() == pytest.approx(constants_of(noise).heading_offset_deg, abs=0.4)
    assert error[:, 2].std() == pytest.approx(2.0, rel=0.15)
    varying = error[:, 2] - error[:, 2].mean()
    assert correlation(varying, 10) == pytest.approx(np.exp(-1.0), abs=0.12)


def test_gyro_has_noise_a_bias_and_a_bias_that_walks(motion: TrueBodyMotion) -> None:
    _, white = error_of(angular_rate, motion, 5.0, only(rate_sigma_rad_s=0.002))
    np.testing.assert_allclose(white.std(axis=0), 0.002, rtol=0.05)
    noise = only(rate_bias_sigma_rad_s=0.01)
    _, bias = error_of(angular_rate, motion, 1.0, noise)
    np.testing.assert_allclose(bias - constants_of(noise).rate_bias_rad_s, 0.0, atol=1e-9)
    t, walk = error_of(angular_rate, motion, 1.0, only(rate_bias_walk=1e-3))
    np.testing.assert_allclose(np.diff(walk, axis=0).std(axis=0), 1e-3, rtol=0.06)
    assert np.abs(walk[-1]).max() < 4e-3 * np.sqrt(t[-1])


def test_accelerometer_has_noise_and_a_bias(motion: TrueBodyMotion) -> None:
    noise = only(acceleration_sigma_m_s2=0.1, acceleration_bias_sigma_m_s2=0.5)
    _, error = error_of(acceleration, motion, 5.0, noise)
    np.testing.assert_allclose(error.std(axis=0), 0.1, rtol=0.05)
    bias = constants_of(noise).acceleration_bias_m_s2
    np.testing.assert_allclose(error.mean(axis=0), bias, atol=0.005)


def test_constant_errors_have_their_sigmas_over_many_dives() -> None:
    noise = TelemetryNoise.model_validate({})
    draws = [constants_of(noise, seed) for seed in range(400)]
    for name, sigma in (
        ("depth_offset_m", noise.depth_offset_sigma_m),
        ("heading_offset_deg", noise.heading_offset_sigma_deg),
        ("rate_bias_rad_s", noise.rate_bias_sigma_rad_s),
        ("acceleration_bias_m_s2", noise.acceleration_bias_sigma_m_s2),
        ("dvl_scale", noise.dvl_scale_sigma),
    ):
        values = np.array([getattr(draw, name) for draw in draws])
        assert values.std() == pytest.approx(sigma, rel=0.12), name
        assert abs(values.mean()) < 0.25 * sigma, name
