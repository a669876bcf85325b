"""Each error of each instrument has the stated size, on series of an hour."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.geometry.earth import north_east
from aquaflow.synthetic import SyntheticConfig
from aquaflow.synthetic.motion import BodyMotion
from aquaflow.synthetic.mounting import mountings_of
from aquaflow.synthetic.path import plan_path
from aquaflow.synthetic.relief import Area
from aquaflow.synthetic.telemetry.altitude import altitude
from aquaflow.synthetic.telemetry.constants import Constants, draw_constants
from aquaflow.synthetic.telemetry.inertial import acceleration, angular_rate, attitude
from aquaflow.synthetic.telemetry.position import position, utc_time
from aquaflow.synthetic.telemetry.pressure import depth, tide, wave
from aquaflow.synthetic.telemetry.sonar import Sonar
from aquaflow.synthetic.telemetry.velocity import velocity
from aquaflow.synthetic.telemetry_noise import TelemetryNoise
from tests.synthetic.without_errors import WITHOUT_ERRORS

Array = npt.NDArray[np.float64]
Rng = np.random.Generator

HOUR = SyntheticConfig(frames=3600, fps=1.0, speed_m_s=0.02)


@pytest.fixture(scope="module")
def motion() -> BodyMotion:
    path = plan_path(HOUR, np.random.default_rng(0))
    return BodyMotion(path, mountings_of(HOUR))


def only(**errors: float) -> TelemetryNoise:
    """These errors and no others."""
    return TelemetryNoise.model_validate({**WITHOUT_ERRORS, **errors})


def constants_of(noise: TelemetryNoise, seed: int = 0) -> Constants:
    return draw_constants(SyntheticConfig(seed=seed, telemetry=noise))


def times(hz: float) -> Array:
    return np.arange(int(3590 * hz)) / hz


def correlation(series: Array, lag: int) -> float:
    return float((series[lag:] * series[:-lag]).mean() / series.var())


Instrument = Callable[[Array, BodyMotion, Constants, TelemetryNoise, Rng], Array]


def error_of(
    instrument: Instrument, motion: BodyMotion, hz: float, noise: TelemetryNoise
) -> tuple[Array, Array]:
    """Times [N] and measurement minus truth [N, K]."""
    t, constants = times(hz), constants_of(noise)
    true = instrument(t, motion, constants_of(only()), only(), np.random.default_rng(1))
    return t, instrument(t, motion, constants, noise, np.random.default_rng(1)) - true


def test_without_errors_every_instrument_measures_the_truth(motion: BodyMotion) -> None:
    t, rng = np.linspace(10.0, 20.0, 50), np.random.default_rng(0)
    known = (motion, constants_of(only()), only(), rng)
    np.testing.assert_allclose(depth(t, *known)[:, 0], motion.origin_w(t)[:, 2])
    np.testing.assert_allclose(angular_rate(t, *known), motion.rate_b(t))
    np.testing.assert_allclose(acceleration(t, *known), motion.force_b(t))
    np.testing.assert_allclose(velocity(t, *known)[:, :3], motion.velocity_b(t))
    measured = Rotation.from_quat(np.roll(attitude(t, *known), -1, axis=1))
    np.testing.assert_allclose(measured.as_matrix(), motion.R_wb(t), atol=1e-12)


def test_depth_noise_is_white_and_comes_in_steps(motion: BodyMotion) -> None:
    _, white = error_of(depth, motion, 5.0, only(depth_sigma_m=0.01))
    assert white.std() == pytest.approx(0.01, rel=0.03)
    assert abs(correlation(white[:, 0], 1)) < 0.05
    noise = only(depth_resolution_m=0.002)
    steps = depth(times(1.0), motion, constants_of(noise), noise, np.random.default_rng(0)) / 0.002
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert len(np.unique(np.round(steps))) > 100


def test_depth_keeps_its_offset_and_rises_with_the_tide(motion: BodyMotion) -> None:
    noise = only(depth_offset_sigma_m=0.1, tide_amplitude_m=1.5)
    t, error = error_of(depth, motion, 1.0, noise)
    constants = constants_of(noise)
    assert error[0, 0] == pytest.approx(constants.depth_offset_m)
    np.testing.assert_allclose(error[:, 0] - error[0, 0], tide(t, constants, noise), atol=1e-9)
    half = np.linspace(0.0, noise.tide_period_s, 1000)
    assert np.ptp(tide(half, constants, noise)) == pytest.approx(3.0, rel=1e-3)
    # An hour of tide is at most a quarter of its range in a twelfth of its period.
    assert 0.0 < np.ptp(error) < 0.8


def test_wave_pressure_has_its_period_and_fades_with_depth(motion: BodyMotion) -> None:
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


def turn_of(motion: BodyMotion, noise: TelemetryNoise, hz: float = 2.0) -> tuple[Array, Array]:
    """[N, 3] degrees: attitude errors about the body's axes, and about the world's."""
    t = times(hz)
    measured = attitude(t, motion, constants_of(noise), noise, np.random.default_rng(2))
    R = Rotation.from_quat(np.roll(measured, -1, axis=1))
    true = Rotation.from_matrix(motion.R_wb(t))
    return (true.inv() * R).as_rotvec(degrees=True), (R * true.inv()).as_rotvec(degrees=True)


def test_attitude_noise_is_white_about_each_axis(motion: BodyMotion) -> None:
    error, _ = turn_of(motion, only(attitude_sigma_deg=0.4))
    np.testing.assert_allclose(error.std(axis=0), 0.4, rtol=0.05)
    assert abs(correlation(error[:, 0], 1)) < 0.05


def test_roll_and_pitch_wander_and_heading_does_not_with_them(motion: BodyMotion) -> None:
    error, _ = turn_of(motion, only(tilt_wander_sigma_deg=0.5, tilt_wander_s=5.0))
    np.testing.assert_allclose(error[:, :2].std(axis=0), 0.5, rtol=0.15)
    for axis in (0, 1):
        assert correlation(error[:, axis], 10) == pytest.approx(np.exp(-1.0), abs=0.12)
    np.testing.assert_allclose(error[:, 2], 0.0, atol=1e-9)


def test_compass_has_an_offset_and_a_wandering_disturbance(motion: BodyMotion) -> None:
    noise = only(heading_offset_sigma_deg=4.0, heading_wander_sigma_deg=2.0, heading_wander_s=5.0)
    _, error = turn_of(motion, noise)
    np.testing.assert_allclose(error[:, :2], 0.0, atol=1e-9)
    assert error[:, 2].mean() == pytest.approx(constants_of(noise).heading_offset_deg, abs=0.4)
    assert error[:, 2].std() == pytest.approx(2.0, rel=0.15)
    varying = error[:, 2] - error[:, 2].mean()
    assert correlation(varying, 10) == pytest.approx(np.exp(-1.0), abs=0.12)


def test_gyro_has_noise_a_bias_and_a_bias_that_walks(motion: BodyMotion) -> None:
    _, white = error_of(angular_rate, motion, 5.0, only(rate_sigma_rad_s=0.002))
    np.testing.assert_allclose(white.std(axis=0), 0.002, rtol=0.05)
    noise = only(rate_bias_sigma_rad_s=0.01)
    _, bias = error_of(angular_rate, motion, 1.0, noise)
    np.testing.assert_allclose(bias - constants_of(noise).rate_bias_rad_s, 0.0, atol=1e-9)
    t, walk = error_of(angular_rate, motion, 1.0, only(rate_bias_walk=1e-3))
    np.testing.assert_allclose(np.diff(walk, axis=0).std(axis=0), 1e-3, rtol=0.06)
    assert np.abs(walk[-1]).max() < 4e-3 * np.sqrt(t[-1])


def test_accelerometer_has_noise_and_a_bias(motion: BodyMotion) -> None:
    noise = only(acceleration_sigma_m_s2=0.1, acceleration_bias_sigma_m_s2=0.5)
    _, error = error_of(acceleration, motion, 5.0, noise)
    np.testing.assert_allclose(error.std(axis=0), 0.1, rtol=0.05)
    bias = constants_of(noise).acceleration_bias_m_s2
    np.testing.assert_allclose(error.mean(axis=0), bias, atol=0.005)


def test_dvl_noise_is_as_large_as_its_figure_of_merit_says_on_average(motion: BodyMotion) -> None:
    noise = only(dvl_sigma_m_s=0.02, dvl_merit_spread=0.3)
    t = times(5.0)
    measured = velocity(t, motion, constants_of(noise), noise, np.random.default_rng(0))
    error = measured[:, :3] - motion.velocity_b(t)
    np.testing.assert_allclose(error.std(axis=0), 0.02, rtol=0.05)
    assert np.median(measured[:, 3]) == pytest.approx(0.02, rel=0.02)
    assert np.log(measured[:, 3]).std() == pytest.approx(0.3, rel=0.05)


def test_dvl_is_out_of_scale_by_one_constant(motion: BodyMotion) -> None:
    noise = only(dvl_scale_sigma=0.1)
    t = times(1.0)
    scale = constants_of(noise).dvl_scale
    measured = velocity(t, motion, constants_of(noise), noise, np.random.default_rng(0))
    np.testing.assert_allclose(measured[:, :3], (1.0 + scale) * motion.velocity_b(t), atol=1e-12)


def test_dvl_drops_samples_and_loses_the_bottom(motion: BodyMotion) -> None:
    t = times(5.0)
    for noise, share, in_a_row in (
        (only(dvl_dropout_share=0.1), 0.1, 1.1),
        (only(dvl_lock_losses_per_min=6.0, dvl_lock_loss_s=5.0), 1.0 / 3.0, 25.0),
    ):
        measured = velocity(t, motion, constants_of(noise), noise, np.random.default_rng(4))
        silent = np.isnan(measured[:, 0])
        begins = np.count_nonzero(np.diff(silent.astype(int)) == 1)
        assert silent.mean() == pytest.approx(share, rel=0.1)
        assert silent.sum() / begins == pytest.approx(in_a_row, rel=0.2)


@pytest.fixture(scope="module")
def flat() -> Sonar:
    area = Area(-60.0, -60.0, 1.0, (128, 128))
    return Sonar(area, np.zeros(area.shape, np.float32))


def heard(motion: BodyMotion, flat: Sonar, noise: TelemetryNoise) -> tuple[Array, Array]:
    """[N] measured altitudes, and true ones."""
    t = times(1.0)
    measured = altitude(t, motion, flat, noise, np.random.default_rng(5))[:, 0]
    return measured, HOUR.floor_depth_m - motion.origin_w(t)[:, 2]


def test_altimeter_has_noise_and_a_resolution(motion: BodyMotion, flat: Sonar) -> None:
    measured, true = heard(motion, flat, only(altitude_sigma_m=0.03))
    assert (measured - true).std() == pytest.approx(0.03, rel=0.05)
    measured, true = heard(motion, flat, only(altitude_resolution_m=0.05))
    np.testing.assert_allclose(measured / 0.05, np.round(measured / 0.05), atol=1e-6)
    assert np.abs(measured - true).max() < 0.026


def test_altimeter_hears_second_echoes_and_nothing_too_far(motion: BodyMotion, flat: Sonar) -> None:
    measured, true = heard(motion, flat, only(altitude_multipath_share=0.1))
    twice = measured > 1.5 * true
    assert twice.mean() == pytest.approx(0.1, rel=0.15)
    np.testing.assert_allclose(measured[twice], 2.0 * true[twice], rtol=1e-3)
    noise = only(altitude_longest_m=1.4, altitude_shortest_m=1.2)
    measured, true = heard(motion, flat, noise)
    near = (true > 1.21) & (true < 1.39)
    assert np.isfinite(measured[near]).all()
    assert np.isnan(measured[(true > 1.401) | (true < 1.199)]).all()
    assert 0.2 < near.mean() < 0.8


def metres(fixes: Array, noise: TelemetryNoise) -> Array:
    """[N, 2] m north and east of the origin."""
    origin = (noise.origin_latitude_deg, noise.origin_longitude_deg)
    return north_east(fixes[:, 0], fixes[:, 1], origin)


def test_fixes_have_their_sigma_their_lag_and_their_outliers(motion: BodyMotion) -> None:
    t = times(1.0)
    noise = only(position_sigma_m=0.5, position_lag_s=5.0)
    fixes = position(t, motion, noise, np.random.default_rng(6))
    assert np.isnan(fixes[:5]).all()
    error = metres(fixes[5:], noise) - motion.origin_w(t[5:] - 5.0)[:, :2]
    np.testing.assert_allclose(error.std(axis=0), 0.5, rtol=0.06)
    assert set(fixes[5:, 2]) == {0.5}
    noise = only(
        position_sigma_m=0.1, position_outlier_share=0.1, position_outlier_sigma_m=50.0,
        position_lag_s=0.0,
    )  # fmt: skip
    fixes = position(t, motion, noise, np.random.default_rng(6))
    error = metres(fixes, noise) - motion.origin_w(t)[:, :2]
    assert (np.abs(error).max(axis=1) > 1.0).mean() == pytest.approx(0.1, rel=0.2)


def test_fixes_without_noise_are_where_the_vehicle_is(motion: BodyMotion) -> None:
    t, noise = times(0.1), only(position_lag_s=0.0)
    fixes = position(t, motion, noise, np.random.default_rng(0))
    np.testing.assert_allclose(metres(fixes, noise), motion.origin_w(t)[:, :2], atol=1e-6)


def test_a_degree_is_as_long_as_on_the_earth(motion: BodyMotion) -> None:
    t = np.array([100.0])
    where = motion.origin_w(t)[0]
    for latitude, north_m, east_m in ((0.0, 110_574.0, 111_320.0), (60.0, 111_412.0, 55_800.0)):
        noise = only(origin_latitude_deg=latitude, position_lag_s=0.0)
        fix = position(t, motion, noise, np.random.default_rng(0))[0]
        assert (fix[0] - latitude) * north_m == pytest.approx(where[0], rel=1e-4)
        assert (fix[1] - noise.origin_longitude_deg) * east_m == pytest.approx(where[1], rel=1e-4)


def test_utc_is_exact_to_the_nanosecond() -> None:
    noise = TelemetryNoise.model_validate({"starts_utc": "2026-06-01T08:00:00.000001Z"})
    at = utc_time(np.array([0.0, 0.1, 1.000000001]), noise)[:, 0].tolist()
    assert at[0] == 1_780_300_800_000_001_000
    assert [b - at[0] for b in at[1:]] == [100_000_000, 1_000_000_001]


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
