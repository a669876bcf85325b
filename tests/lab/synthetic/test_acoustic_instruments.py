"""Each error of DVL, altimeter and acoustic position has the stated size, on series of an hour."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.earth import north_east
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.relief import Area
from aquaflow.lab.synthetic.telemetry.measurement import altitude, position, utc_time, velocity
from aquaflow.lab.synthetic.telemetry.sonar import Sonar
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise
from tests.lab.synthetic.an_hour import HOUR, constants_of, motion_of_an_hour, only, times

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def motion() -> TrueBodyMotion:
    return motion_of_an_hour()


def test_dvl_noise_is_as_large_as_its_figure_of_merit_says_on_average(
    motion: TrueBodyMotion,
) -> None:
    noise = only(dvl_sigma_m_s=0.02, dvl_merit_spread=0.3)
    t = times(5.0)
    measured = velocity(t, motion, constants_of(noise), noise, np.random.default_rng(0))
    error = measured[:, :3] - motion.velocity_b(t)
    np.testing.assert_allclose(error.std(axis=0), 0.02, rtol=0.05)
    assert np.median(measured[:, 3]) == pytest.approx(0.02, rel=0.02)
    assert np.log(measured[:, 3]).std() == pytest.approx(0.3, rel=0.05)


def test_dvl_is_out_of_scale_by_one_constant(motion: TrueBodyMotion) -> None:
    noise = only(dvl_scale_sigma=0.1)
    t = times(1.0)
    scale = constants_of(noise).dvl_scale
    measured = velocity(t, motion, constants_of(noise), noise, np.random.default_rng(0))
    np.testing.assert_allclose(measured[:, :3], (1.0 + scale) * motion.velocity_b(t), atol=1e-12)


def test_dvl_drops_samples_and_loses_the_bottom(motion: TrueBodyMotion) -> None:
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


def heard(motion: TrueBodyMotion, flat: Sonar, noise: TelemetryNoise) -> tuple[Array, Array]:
    """[N] measured altitudes, and true ones."""
    t = times(1.0)
    measured = altitude(t, motion, flat, noise, np.random.default_rng(5))[:, 0]
    return measured, HOUR.floor_depth_m - motion.origin_w(t)[:, 2]


def test_altimeter_has_noise_and_a_resolution(motion: TrueBodyMotion, flat: Sonar) -> None:
    measured, true = heard(motion, flat, only(altitude_sigma_m=0.03))
    assert (measured - true).std() == pytest.approx(0.03, rel=0.05)
    measured, true = heard(motion, flat, only(altitude_resolution_m=0.05))
    np.testing.assert_allclose(measured / 0.05, np.round(measured / 0.05), atol=1e-6)
    assert np.abs(measured - true).max() < 0.026


def test_altimeter_hears_second_echoes_and_nothing_too_far(
    motion: TrueBodyMotion, flat: Sonar
) -> None:
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


def test_fixes_have_their_sigma_their_lag_and_their_outliers(motion: TrueBodyMotion) -> None:
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


def test_fixes_without_noise_are_where_the_vehicle_is(motion: TrueBodyMotion) -> None:
    t, noise = times(0.1), only(position_lag_s=0.0)
    fixes = position(t, motion, noise, np.random.default_rng(0))
    np.testing.assert_allclose(metres(fixes, noise), motion.origin_w(t)[:, :2], atol=1e-6)


def test_a_degree_is_as_long_as_on_the_earth(motion: TrueBodyMotion) -> None:
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
