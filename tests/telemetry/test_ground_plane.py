"""A line of fixes and the ground that cameras look squarely at: north, place, and their sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config import FusionConfig
from aquaflow.geometry.earth import latitude_longitude
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.estimator import Estimate, estimate
from aquaflow.telemetry.ground_plane import SLOPE_SIGMA, down_into_ground, mean_normal
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.types import Position

Array = npt.NDArray[np.float64]

M_PER_UNIT = 2.5
ALTITUDE_M = 2.0
R_MN = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix()
"""The map's axes: any."""
LOOKS_DOWN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""R_nc of a camera whose top is north."""


def line(heading_deg: float, aside_deg: float) -> tuple[CameraPath, Array]:
    """A path of 4 m with ten pictures, and what it does in n [10, 3]; the camera looks so far aside
    of straight down."""
    along = np.linspace(0.0, 4.0, 10)
    heading = np.radians(heading_deg)
    p_n = np.column_stack([along * np.cos(heading), along * np.sin(heading), np.zeros(10)])
    R_nc = Rotation.from_euler("zy", [heading_deg, aside_deg], degrees=True).as_matrix()
    R_mc = np.repeat((R_MN @ R_nc @ LOOKS_DOWN)[None], 10, axis=0)
    return CameraPath(np.arange(10.0), R_mc, p_n @ R_MN.T / M_PER_UNIT), p_n


def ground(slope_deg: float = 0.0) -> Array:
    """[K, 3] of the map: even ground with a relief of 5 cm."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-3.0, 7.0, (2, 2000))
    z = ALTITUDE_M + np.tan(np.radians(slope_deg)) * y + rng.normal(0.0, 0.05, 2000)
    return np.asarray(np.column_stack([x, y, z]) @ R_MN.T / M_PER_UNIT)


def found(path: CameraPath, p_n: Array, points: Array) -> Estimate:
    """From exact fixes that state 2 cm."""
    telemetry = Telemetry()
    for t_s, a, b in zip(path.t_s, *latitude_longitude(p_n, (63.4, 10.4)), strict=True):
        telemetry.add(Position(round(t_s * 1e9), 0, "usbl", a, b, 0.02))
    settings = FusionConfig(position_lag_sigma_s=0.0)
    return estimate(telemetry, path, settings, None, lambda: points)


@pytest.mark.parametrize(("heading_deg", "slope_deg"), [(20.0, 0.0), (200.0, 8.0), (-75.0, -8.0)])
def test_a_line_of_fixes_over_a_ground_seen_squarely_has_north_place_and_metres(
    heading_deg: float, slope_deg: float
) -> None:
    path, p_n = line(heading_deg, 5.0)
    frame = found(path, p_n, ground(slope_deg)).frame
    assert (frame.metric, frame.level, frame.on_ground) == (True, False, True)
    assert frame.georeferenced
    assert frame.axes == "x to true north, y to the right of it, z into the ground"
    placed = path.p_m @ frame.T_nm.R.T * frame.T_nm.scale + frame.T_nm.t
    np.testing.assert_allclose(placed[:, :2] - placed[0, :2], p_n[:, :2], atol=0.06)
    tilt = np.degrees(np.arccos((frame.T_nm.R @ R_MN)[2, 2]))
    assert tilt < abs(slope_deg) + 1.0
    assert tilt < 2.0 * np.degrees(frame.tilt_sigma_rad)
    assert frame.tilt_sigma_rad <= SLOPE_SIGMA
    assert abs(np.log(frame.T_nm.scale / M_PER_UNIT)) < 2.0 * frame.scale_sigma
    used = {source.kind: source.used for source in frame.sources}
    assert used["level_ground"] == 2000


def test_a_line_of_fixes_over_a_ground_seen_obliquely_has_no_vertical() -> None:
    path, p_n = line(20.0, 45.0)
    frame = found(path, p_n, ground()).frame
    assert not frame.has_vertical
    assert not frame.georeferenced
    assert not any(source.kind == "level_ground" for source in frame.sources)


def test_down_is_into_the_ground_whatever_side_its_normal_is_found_on() -> None:
    points, looks = ground(), line(0.0, 0.0)[0].R_mc[:, :, 2]
    for turned in (np.eye(3), -np.eye(3)):
        down = down_into_ground(points @ turned, np.ones(len(points)), looks @ turned)
        assert down is not None
        assert np.degrees(np.arccos(down @ (R_MN[:, 2] @ turned))) < 1.0


def test_outliers_do_not_turn_the_plane() -> None:
    points = ground()
    points[::10] += 3.0 * R_MN[:, 2]
    normal = mean_normal(points, np.ones(len(points)))
    assert normal is not None
    assert abs(normal @ R_MN[:, 2]) > np.cos(np.radians(1.0))


def test_a_ball_and_a_handful_of_points_have_no_plane() -> None:
    ball = np.random.default_rng(2).normal(size=(500, 3))
    assert mean_normal(ball, np.ones(500)) is None
    assert mean_normal(ground()[:20], np.ones(20)) is None


def test_fixes_in_one_place_say_nothing_of_the_ground() -> None:
    path, p_n = line(20.0, 0.0)
    frame = found(path, np.zeros_like(p_n), ground()).frame
    assert not frame.has_vertical


def test_the_heading_of_a_frame_without_north_stays_the_first_pictures_top() -> None:
    path, p_n = line(20.0, 0.0)
    frame = replace(found(path, p_n, ground()).frame, north="first keyframe", origin=None)
    assert frame.ahead == "first picture's top"
