"""The path of a running dive, as the viewer's slider has it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer.live_viewer import LONGEST_PATH, LivePath
from aquaflow.telemetry.world_frame import WorldFrame
from tests.metric_scenes import metric_frame

RATE = 4


def tracked(index: int) -> Any:
    """A posed frame of four a second."""
    frame = SimpleNamespace(index=index, t_ns=index * 10**9 // RATE)
    T_wc = Sim3(np.eye(3), np.array([0.1 * index, 0.0, 0.0]))
    return SimpleNamespace(frame=frame, T_wc=T_wc, quality=SimpleNamespace(inlier_share=0.5))


def heard(**kinds: tuple[object, float]) -> Any:
    return {"vehicle": {kind: {"value": v, "age_s": age} for kind, (v, age) in kinds.items()}}


def test_poses_come_with_seconds_depth_heading_and_the_nearest_picture() -> None:
    path = LivePath()
    path.add(tracked(8), WorldFrame.unknown())
    path.hear(heard(depth=(3.5, 0.2)))
    path.add(tracked(12), metric_frame())
    poses, moments = path.rows([8])
    assert np.allclose(poses[:, 0], [0.8, 1.2])
    assert moments[:, 0].tolist() == [0.0, 1.0]
    assert np.isnan(moments[0, 1:3]).all()
    assert moments[1, 1] == 3.5
    assert 0.0 <= moments[1, 2] < 360.0
    assert moments[:, 3].tolist() == [8.0, 8.0]


def test_a_depth_that_is_no_longer_measured_is_no_poses() -> None:
    path = LivePath()
    path.hear(heard(depth=(3.5, 60.0)))
    path.add(tracked(0), WorldFrame.unknown())
    path.hear({})
    path.add(tracked(1), WorldFrame.unknown())
    assert np.isnan(path.rows([])[1][:, 1]).all()


def test_utc_of_the_first_pose_follows_from_what_a_clock_says_now() -> None:
    path = LivePath()
    path.hear(heard(utc_time=("2026-11-24T03:00:10.000Z", 0.5)))
    assert path.began is None
    for index in range(0, 5 * RATE + 1, RATE):
        path.add(tracked(index), WorldFrame.unknown())
    path.hear(heard(utc_time=("2026-11-24T03:00:10.000Z", 0.5)))
    assert path.began is not None
    assert path.began.isoformat() == "2026-11-24T03:00:05.500000+00:00"


def test_a_frame_that_stays_the_newest_has_one_pose() -> None:
    path = LivePath()
    for index in (3, 3, 4):
        path.add(tracked(index), WorldFrame.unknown())
    assert len(path.rows([])[0]) == 2


def test_a_long_path_is_thinned() -> None:
    path = LivePath()
    for index in range(LONGEST_PATH + 3):
        path.add(tracked(index), WorldFrame.unknown())
    poses, moments = path.rows([0])
    assert LONGEST_PATH // 2 <= len(poses) == len(moments) <= LONGEST_PATH
    assert moments[0, 0] == 0.0
