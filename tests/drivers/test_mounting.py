"""From the sensor's own axes and place to the vehicle's body."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config.stage import MountingConfig
from aquaflow.drivers import samples as rotation
from aquaflow.drivers.mounting import BodyFrame, Mounting
from aquaflow.drivers.samples import plausible
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    Position,
    UtcTime,
    Velocity,
)

STAMP = (10**9, 10**9, "s")
ANGLES = {"roll_deg": 20.0, "pitch_deg": -35.0, "yaw_deg": 120.0}
R_bs = Rotation.from_euler("ZYX", [120, -35, 20], degrees=True)
AT_ORIGIN = Mounting(MountingConfig())


def mounted(**settings) -> Mounting:
    return Mounting(MountingConfig.model_validate(settings))


def attitude(R_nb: Rotation, t_ns: int = 10**9) -> Attitude:
    w, x, y, z = np.roll(R_nb.as_quat(), 1)
    return Attitude(t_ns, t_ns, "ahrs", (w, x, y, z))


def test_quaternions_do_what_scipys_rotations_do():
    rng = np.random.default_rng(1)
    for _ in range(50):
        angles = rng.uniform(-3, 3, 3) * [1, 0.5, 1]
        other = Rotation.random(random_state=rng)
        mine = rotation.from_euler(*angles)
        truth = Rotation.from_euler("ZYX", angles[::-1])
        v = rng.normal(size=3)
        p = tuple(np.roll(other.as_quat(), 1))

        np.testing.assert_allclose(rotation.rotate(mine, tuple(v)), truth.apply(v), atol=1e-12)
        both = np.roll(rotation.product(mine, p), -1)
        np.testing.assert_allclose(
            Rotation.from_quat(both).as_matrix(), (truth * other).as_matrix(), atol=1e-12
        )
        undone = rotation.rotate(rotation.inverse(mine), rotation.rotate(mine, tuple(v)))
        np.testing.assert_allclose(undone, v, atol=1e-12)


def test_vectors_are_turned_from_the_sensor_into_the_body():
    body, mounting = BodyFrame(), mounted(**ANGLES)
    v = (0.3, -0.2, 0.1)
    expected = pytest.approx(tuple(R_bs.apply(v)))

    assert body.refer(Velocity(*STAMP, v, 0.01), mounting).velocity_m_s == expected
    assert body.refer(AngularRate(*STAMP, v), mounting).rate_rad_s == expected
    assert body.refer(Acceleration(*STAMP, v), mounting).acceleration_m_s2 == expected


def test_a_dvl_that_points_backwards_has_x_and_y_negated():
    (vx, vy, vz) = (
        BodyFrame()
        .refer(Velocity(*STAMP, (0.5, 0.2, 0.1), 0.01), mounted(yaw_deg=180))
        .velocity_m_s
    )

    assert (vx, vy, vz) == pytest.approx((-0.5, -0.2, 0.1))


def test_the_attitude_of_a_turned_sensor_becomes_the_bodys():
    R_nb = Rotation.from_euler("ZYX", [1.0, 0.2, -0.3])

    told = BodyFrame().refer(attitude(R_nb * R_bs), mounted(**ANGLES))

    np.testing.assert_allclose(
        Rotation.from_quat(np.roll(told.wxyz, -1)).as_matrix(), R_nb.as_matrix(), atol=1e-12
    )


def test_a_dvl_off_the_origin_does_not_see_the_body_turn():
    body = BodyFrame()
    omega, arm, v = (0.1, -0.2, 0.3), (0.4, 0.1, 0.2), np.array([0.5, 0.0, 0.1])
    seen = v + np.cross(omega, arm)
    dvl = mounted(position_m=arm)

    before = body.refer(Velocity(*STAMP, tuple(seen), 0.01), dvl)
    body.refer(AngularRate(*STAMP, omega), AT_ORIGIN)
    after = body.refer(Velocity(*STAMP, tuple(seen), 0.01), dvl)
    later = body.refer(Velocity(3 * 10**9, 3 * 10**9, "s", tuple(seen), 0.01), dvl)

    assert before.velocity_m_s == pytest.approx(tuple(seen))
    assert after.velocity_m_s == pytest.approx(tuple(v))
    assert later.velocity_m_s == pytest.approx(tuple(seen)), "a rate of 2 s ago was used"


def test_depth_and_altitude_are_those_of_the_origin_as_the_body_leans():
    body, arm = BodyFrame(), (1.0, 0.0, 0.2)
    sensor = mounted(position_m=arm)

    level = body.refer(Depth(*STAMP, 10.0), sensor)
    R_nb = Rotation.from_euler("ZYX", [0.7, -0.5, 0.0])  # bow down
    body.refer(attitude(R_nb), AT_ORIGIN)
    leaning = body.refer(Depth(*STAMP, 10.0), sensor)
    altitude = body.refer(Altitude(*STAMP, 3.0), sensor)
    below = R_nb.apply(arm)[2]

    assert below > 0.5
    assert level.depth_m == pytest.approx(9.8)
    assert leaning.depth_m == pytest.approx(10.0 - below)
    assert altitude.altitude_m == pytest.approx(3.0 + below)


@pytest.mark.parametrize("latitude_deg", [-60.0, 0.5, 75.0])
def test_a_fix_is_that_of_the_origin_where_the_attitude_is_known(latitude_deg):
    body, arm = BodyFrame(), (2.0, -0.5, -1.0)
    R_nb = Rotation.from_euler("ZYX", [0.7, -0.4, 0.2])
    body.refer(attitude(R_nb), AT_ORIGIN)
    antenna = Position(*STAMP, latitude_deg, 179.99999, 1.5)

    fix = body.refer(antenna, mounted(position_m=arm))

    north, east = earth_metres(fix, antenna)
    assert (north, east) == pytest.approx(tuple(-R_nb.apply(arm)[:2]), abs=1e-3)
    assert fix.sigma_m == 1.5
    assert -180.0 <= fix.longitude_deg <= 180.0


def earth_metres(there: Position, here: Position) -> tuple[float, float]:
    """North and east from ``here``, by points of the ellipsoid in space."""
    a, e2 = 6_378_137.0, 0.00669437999014
    points = []
    for fix in (there, here):
        latitude, longitude = np.radians([fix.latitude_deg, fix.longitude_deg])
        n = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
        x, y = n * np.cos(latitude) * np.array([np.cos(longitude), np.sin(longitude)])
        points.append(np.array([x, y, n * (1 - e2) * np.sin(latitude)]))
    up = Rotation.from_euler("ZY", [longitude, -latitude]).as_matrix()
    _, east, north = up.T @ (points[0] - points[1])
    return float(north), float(east)


def test_a_fix_is_less_certain_by_the_arm_where_no_attitude_is_known():
    body, antenna = BodyFrame(), Position(*STAMP, 10.0, 20.0, 3.0)
    body.refer(attitude(Rotation.identity(), t_ns=3 * 10**9), AT_ORIGIN)

    fix = body.refer(antenna, mounted(position_m=(4.0, 4.0, 7.0)))

    assert (fix.latitude_deg, fix.longitude_deg) == (10.0, 20.0)
    assert fix.sigma_m == pytest.approx(5.0)


def test_at_a_pole_an_arm_is_left_in():
    body, antenna = BodyFrame(), Position(*STAMP, 90.0, 20.0, 3.0)
    body.refer(attitude(Rotation.identity()), AT_ORIGIN)

    assert body.refer(antenna, mounted(position_m=(4.0, 4.0, 0.0))) == antenna


def test_what_has_no_place_is_left_as_it_is():
    lights = Lights(*STAMP, 0.5)
    sensor = mounted(position_m=(1, 2, 3), **ANGLES)

    utc = UtcTime(*STAMP, 10**18)
    assert BodyFrame().refer(lights, sensor) is lights
    assert BodyFrame().refer(utc, sensor) is utc
    force = Acceleration(*STAMP, (0.0, 0.0, -9.8))
    assert BodyFrame().refer(force, mounted(position_m=(1, 2, 3))) == force


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("bad", [NAN, INF, -INF, 1e9, -1e9])
def test_no_vehicle_measures_this(bad):
    samples = [
        Depth(*STAMP, bad),
        Altitude(*STAMP, bad),
        Lights(*STAMP, bad),
        Velocity(*STAMP, (0.0, bad, 0.0), 0.01),
        AngularRate(*STAMP, (0.0, 0.0, bad)),
        Acceleration(*STAMP, (bad, 0.0, 0.0)),
        Attitude(*STAMP, (1.0, bad, 0.0, 0.0)),
        Position(*STAMP, bad, 20.0, 1.0),
        Position(*STAMP, 10.0, bad, 1.0),
    ]
    assert not any(map(plausible, samples))


@pytest.mark.parametrize("merit", [NAN, INF, -0.1])
def test_a_velocity_without_a_usable_figure_of_merit_is_not_plausible(merit):
    assert not plausible(Velocity(*STAMP, (0.0, 0.0, 0.0), merit))


@pytest.mark.parametrize("sigma_m", [NAN, INF, 0.0, -1.0])
def test_a_fix_without_a_usable_accuracy_is_not_plausible(sigma_m):
    assert plausible(Position(*STAMP, 10.0, 20.0, 1.0))
    assert not plausible(Position(*STAMP, 10.0, 20.0, sigma_m))
    assert not plausible(Position(*STAMP, 0.0, 0.0, 1.0))


@pytest.mark.parametrize("utc_s", [0, 315_964_800, 4_102_444_801])
def test_a_receiver_that_does_not_know_the_year_is_not_believed(utc_s):
    assert plausible(UtcTime(*STAMP, 1_795_365_000 * 10**9))
    assert not plausible(UtcTime(*STAMP, utc_s * 10**9))
