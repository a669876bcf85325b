"""Poses on a real link to a simulated ArduSub, which reads them as ArduPilot does."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.config.service import PoseConfig
from aquaflow.geometry.similarity import so3_log
from aquaflow.live.vehicle.pose_output import PoseOutput
from aquaflow.sim_drivers.devices.visual_odometry import VisualOdometry
from aquaflow.telemetry.world_frame import WorldFrame
from tests.drivers.simulated_links import (
    Rig,
    Running,
    mavlink_pty,
    mavlink_udp,
    motion,
    running,
    until,
)
from tests.live.live_scenes import Told
from tests.live.vehicle.swims import MOUNTINGS, diving, frame, seen, show, turned

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

SECONDS = np.arange(21) / 10.0
CLOCK_NS = 50_000_000
"""By which a clock learned within a second may be wrong on a machine that is busy."""


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    told = Told(tmp_path / "dive")
    yield told
    told.close()


def introduced(session: Running) -> None:
    """Until the autopilot has said what it is, and both know the other's clock."""
    session.play()
    until(lambda: session.telemetry.clocks()["device"].round_trips)


def swum(
    session: Running, told: Told, out: PoseOutput, mounting: str, known: WorldFrame
) -> tuple[int, int]:
    """Swim the way; the autopilot's clock at its first and last frame."""
    told.feed.send = session.telemetry.send  # type: ignore[method-assign]
    first_ns = time.monotonic_ns() - round(SECONDS[-1] * 1e9)
    for s, pose in zip(SECONDS, diving(SECONDS), strict=True):
        show(told, out, seen(pose, known, mounting), t_ns=first_ns + round(s * 1e9))
    offset_ns = session.telemetry.clocks()["device"].offset_ns
    return first_ns - offset_ns, first_ns - offset_ns + round(SECONDS[-1] * 1e9)


def vision(rig: Rig) -> VisualOdometry:
    heard: Any = rig.protocol.vision
    assert isinstance(heard, VisualOdometry)
    return heard


@pytest.mark.parametrize("mounting", MOUNTINGS)
@pytest.mark.parametrize("build", [mavlink_udp, mavlink_pty])
def test_an_ardusub_reads_the_way_that_the_vehicle_swam(
    build: Callable[[Path], Rig], mounting: str, told: Told, tmp_path: Path
) -> None:
    rig, known = build(tmp_path), frame(mounting)
    out = PoseOutput(PoseConfig(), told.feed, lambda sub_map: known)
    with running(rig, motion(), speed=1.0) as session:
        introduced(session)
        _, last_ns = swum(session, told, out, mounting, known)
        until(lambda: len(vision(rig).poses) == out.sent)
    heard, path = vision(rig), diving(SECONDS)[2:]
    assert out.sent == len(path)
    assert (heard.complaints, heard.dropped) == ([], 0)
    assert heard.rate_hz() == pytest.approx(10.0, rel=1e-9 * CLOCK_NS / SECONDS[-1])
    assert abs(heard.poses[-1].t_ns - last_ns) < CLOCK_NS
    assert heard.poses[-1].position_m[2] == pytest.approx(0.55, abs=1e-6)
    for pose, truth in zip(heard.poses, path, strict=True):
        assert np.allclose(pose.position_m, truth.t_m, atol=1e-6)
        assert np.allclose(pose.R, truth.R, atol=1e-6)
        assert np.allclose(pose.velocity_m_s, truth.R @ [0.5, 0.0, 0.275], atol=2e-3)
        assert np.allclose(pose.rate_rad_s, [0.0, 0.0, 0.3], atol=1e-5)
    expected = known.position_covariance(path[-1].t_m)
    assert np.all(np.diag(heard.poses[-1].covariance)[:3] > np.diag(expected))
    assert {pose.reset_counter for pose in heard.poses} == {0}


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_an_ardusub_reads_motions_in_the_bodys_axes(
    mounting: str, told: Told, tmp_path: Path
) -> None:
    rig, known = mavlink_udp(tmp_path), frame(mounting)
    out = PoseOutput(PoseConfig(message="vision_position_delta"), told.feed, lambda sub_map: known)
    with running(rig, motion(), speed=1.0) as session:
        introduced(session)
        swum(session, told, out, mounting, known)
        until(lambda: len(vision(rig).deltas) == out.sent)
    before, after = diving(SECONDS)[:2]
    assert out.sent == len(SECONDS) - 1
    assert vision(rig).complaints == []
    for delta in vision(rig).deltas:
        assert np.allclose(delta.position_m, after.R.T @ (after.t_m - before.t_m), atol=1e-6)
        assert np.allclose(delta.angle_rad, so3_log(before.R.T @ after.R), atol=1e-6)
        assert delta.since_ns == pytest.approx(1e8, abs=2_000)


def test_an_ardusub_hears_of_a_jump_by_its_reset_counter(told: Told, tmp_path: Path) -> None:
    rig, corrected = mavlink_udp(tmp_path), turned(frame(), [0.5, 0, 0, 0, 0, 0, 0])
    asked: list[int] = []

    def frame_of(sub_map: int) -> WorldFrame:
        asked.append(sub_map)
        return frame() if len(asked) <= 10 else corrected

    out = PoseOutput(PoseConfig(), told.feed, frame_of)
    with running(rig, motion(), speed=1.0) as session:
        introduced(session)
        swum(session, told, out, "forward", frame())
        until(lambda: len(vision(rig).poses) == out.sent)
    assert [pose.reset_counter for pose in vision(rig).poses] == [0] * 8 + [1] * 9
    assert vision(rig).complaints == []


def test_an_ardusub_gets_no_pose_from_a_map_without_metres(told: Told, tmp_path: Path) -> None:
    rig = mavlink_udp(tmp_path)
    out = PoseOutput(PoseConfig(), told.feed, lambda sub_map: WorldFrame.unknown())
    with running(rig, motion(), speed=1.0) as session:
        introduced(session)
        swum(session, told, out, "forward", frame())
        beats = rig.protocol.heartbeats
        until(lambda: rig.protocol.heartbeats > beats)
    assert vision(rig).poses == []
    assert out.sent == 0
