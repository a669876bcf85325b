"""The rows of trajectory.csv, from poses made by hand."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.dive.metric_outputs import MetricOutputs, Navigation, path_rows
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.types import Depth, Frame, UtcTime
from tests.metric_scenes import SIGMAS, TRONDHEIM, metric_frame

S = 1_000_000_000
PICTURE = np.zeros((48, 64, 3), np.uint8)
SPEED = np.array([0.3, 0.4, 0.0])
START = datetime(2026, 11, 22, 12, tzinfo=timezone.utc)

STRAIGHT = np.eye(3)
AHEAD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Camera axes to forward, right, down, of a camera that looks ahead."""


def tracked(index: int, sub_map: int = 0) -> Tracked:
    frame = Frame(index, index * S // 10, 0, PICTURE, guess_camera(64, 48))
    return Tracked(frame, FrameClass.COMMON, sub_map, 0, Sim3.identity())


def rows(
    frame: WorldFrame, R_nc: np.ndarray = STRAIGHT, navigation: Navigation | None = None
) -> list[PoseRow]:
    """Twenty poses at 10 Hz, at a speed of half a metre a second."""
    outputs = MetricOutputs({0: frame}, navigation or Navigation())
    poses = {i: Sim3(R_nc, SPEED * i / 10.0) for i in range(20)}
    return path_rows(outputs, [tracked(i) for i in reversed(range(20))], poses)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (77.0, -12.0, 5.0), (271.5, 30.0, -8.0)])
@pytest.mark.parametrize("mounted", [True, False])
def test_heading_pitch_and_roll_are_the_bodys_whatever_the_mounting(
    angles: tuple[float, float, float], mounted: bool
) -> None:
    R_nb = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    R_bc = AHEAD
    if mounted:
        R_bc = Rotation.from_euler("y", -80.0, degrees=True).as_matrix() @ AHEAD
    frame = metric_frame(T_bc=Sim3(R_bc, np.zeros(3)) if mounted else None)
    row = rows(frame, R_nb @ R_bc)[0]
    assert (row.heading_deg, row.pitch_deg, row.roll_deg) == pytest.approx(angles, abs=1e-9)


def test_speed_is_that_of_the_path_also_at_its_ends_and_between_rare_pictures() -> None:
    assert [row.speed_m_s for row in rows(metric_frame())] == pytest.approx([0.5] * 20)
    outputs = MetricOutputs({0: metric_frame()})
    rare = [replace(tracked(i), frame=replace(tracked(0).frame, index=i, t_ns=t * S))
            for i, t in enumerate((0, 2, 4, 60))]  # fmt: skip
    poses = {i: Sim3(np.eye(3), np.array([1.0 * i, 0.0, 0.0])) for i in range(4)}
    speeds = [row.speed_m_s for row in path_rows(outputs, rare, poses)]
    assert speeds == [0.5, 0.5, None, None]  # across a minute without a picture nothing is known


def test_the_sigmas_are_those_of_the_frame() -> None:
    row = rows(metric_frame())[0]  # at the origin only the translation counts
    assert row.sigma_position_m == pytest.approx(SIGMAS[:3].max())
    assert row.sigma_heading_deg == pytest.approx(np.degrees(SIGMAS[5]))


def test_without_gravity_no_point_has_a_sigma_and_no_pose_a_heading() -> None:
    row = rows(metric_frame(level=False))[3]
    assert row.sigma_position_m is row.sigma_heading_deg is row.heading_deg is None
    assert row.speed_m_s == pytest.approx(0.5)


def test_places_go_north_and_east_from_the_origin() -> None:
    first, *_, last = rows(metric_frame())
    assert (first.latitude_deg, first.longitude_deg) == pytest.approx(
        (TRONDHEIM.latitude_deg, TRONDHEIM.longitude_deg), abs=1e-9
    )
    assert last.latitude_deg is not None
    assert last.longitude_deg is not None
    north_m = np.radians(last.latitude_deg - TRONDHEIM.latitude_deg) * 6.39e6
    assert north_m == pytest.approx(last.x, rel=0.01)
    assert last.longitude_deg > TRONDHEIM.longitude_deg


def test_what_was_measured_is_that_of_the_moment() -> None:
    telemetry = Telemetry()
    for t_s, depth_m in ((0, 3.0), (2, 5.0)):
        telemetry.add(Depth(t_s * S, t_s * S, "bar30", depth_m))
    for t_s in range(5):
        utc_ns = (round(START.timestamp()) + t_s) * S
        telemetry.add(UtcTime(t_s * S, t_s * S, "gps/RMC", utc_ns))
    row = rows(metric_frame(), navigation=Navigation.of(telemetry))[10]
    assert row.utc is not None
    assert abs(row.utc - START - timedelta(seconds=1)) < timedelta(microseconds=10)
    assert row.depth_m == pytest.approx(4.0)
    assert row.altitude_m is None


def test_a_map_without_telemetry_says_positions_and_nothing_else() -> None:
    row = rows(WorldFrame.unknown())[10]
    assert (row.index, row.t_s, row.unit, row.x, row.y) == (10, 1.0, "map units", 0.3, 0.4)
    known = {"index", "t_s", "sub_map", "x", "y", "z", "unit"}
    assert {name for name in vars(row) if getattr(row, name) is not None} == known


def test_each_sub_map_has_its_own_unit_and_rows_are_in_order() -> None:
    outputs = MetricOutputs({0: metric_frame(), 1: WorldFrame.unknown()})
    results = [tracked(2, 1), tracked(0, 0), tracked(1, 0), tracked(3, 0)]
    poses = {i: Sim3.identity() for i in range(3)}  # frame 3 has none
    found = path_rows(outputs, results, poses)
    assert [(row.index, row.sub_map, row.unit) for row in found] == [
        (0, 0, "m"), (1, 0, "m"), (2, 1, "map units"),
    ]  # fmt: skip
