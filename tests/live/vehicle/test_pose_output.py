"""Poses for the autopilot: their frames and scale, and when none is sent."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.config.service import PoseConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.geometry.similarity import Sim3, so3_log
from aquaflow.live.checkpoint.resume import Choice
from aquaflow.live.clock_reading import Continued
from aquaflow.live.health.http import exposition
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.onboard import map_live, refuse_without_scale
from aquaflow.live.report import report
from aquaflow.live.vehicle.pose_output import PoseOutput, Withheld
from aquaflow.sources.outbound import BodyPose, BodyPoseChange
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import FrameClass, Tracked
from tests.live.health.reports import REPORT
from tests.live.live_scenes import VEHICLE, Told, ToldFeed, frame_of
from tests.live.vehicle.swims import MOUNTINGS, diving, frame, seen, show, turned

SECONDS = np.arange(21) / 10.0
ASIDE = np.array([0.2, 0.0, 0.0])
"""In map units: 0.41 m."""


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    told = Told(tmp_path / "dive")
    yield told
    told.close()


def output(told: Told, known: WorldFrame, **settings: Any) -> PoseOutput:
    return PoseOutput(PoseConfig(enabled=True, **settings), told.feed, lambda sub_map: known)


def dive(told: Told, out: PoseOutput, known: WorldFrame, mounting: str = "forward") -> None:
    for pose in diving(SECONDS):
        show(told, out, seen(pose, known, mounting))


def poses(told: Told) -> list[BodyPose]:
    return [word for word in told.feed.told if isinstance(word, BodyPose)]


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_a_descent_of_55_cm_is_55_cm_down_whichever_way_the_camera_looks(
    told: Told, mounting: str
) -> None:
    known = frame(mounting)
    dive(told, output(told, known), known, mounting)
    heard, truth = poses(told), diving(SECONDS)[-len(poses(told)) :]
    assert len(heard) == len(SECONDS) - 2
    assert heard[-1].t_m[2] == pytest.approx(0.55, abs=1e-9)
    for word, pose in zip(heard, truth, strict=True):
        assert np.allclose(word.t_m, pose.t_m, atol=1e-9)
        assert np.allclose(word.R, pose.R, atol=1e-9)
        assert np.allclose(word.velocity_m_s, [0.5, 0.0, 0.275], atol=2e-3)
        assert np.allclose(word.rate_rad_s, [0.0, 0.0, 0.3], atol=1e-9)
        assert word.north


def test_the_stated_mounting_counts_where_the_frame_knows_none(told: Told) -> None:
    known = frame(None)
    dive(told, output(told, known, mounting=MOUNTINGS["down"]), known, "down")
    assert poses(told)[-1].t_m[2] == pytest.approx(0.55, abs=1e-9)


UNUSABLE = {
    Withheld.NO_SCALE: WorldFrame.unknown(),
    Withheld.VAGUE_SCALE: frame(scale_sigma=0.06),
    Withheld.NOT_LEVEL: replace(frame(), level=False),
    Withheld.NO_MOUNTING: frame(None),
    Withheld.VAGUE_POSITION: replace(frame(), covariance=np.diag([400.0, *[1e-4] * 6])),
}


@pytest.mark.parametrize("reason", UNUSABLE)
def test_nothing_is_sent_while_it_could_mislead_and_health_says_why(
    told: Told, reason: Withheld
) -> None:
    out = output(told, UNUSABLE[reason])
    dive(told, out, frame())
    assert poses(told) == []
    assert out.to_json()["reason"] == reason.value
    assert out.withheld[reason] >= len(SECONDS) - 2
    assert f'aquaflow_poses_withheld_total{{reason="{reason.value}"}}' in exposition(
        REPORT | {"pose_output": out.to_json()}
    )


def test_a_sigma_that_is_not_a_number_sends_nothing(told: Told) -> None:
    out = output(told, frame(scale_sigma=float("nan")))
    dive(told, out, frame())
    assert poses(told) == []


def test_poses_begin_when_the_scale_becomes_known_during_the_dive(told: Told) -> None:
    known = WorldFrame.unknown()
    out = PoseOutput(PoseConfig(), told.feed, lambda sub_map: known)
    path = diving(SECONDS)
    for k, pose in enumerate(path):
        known = frame() if k >= 10 else known
        show(told, out, seen(pose, frame()))
    assert out.withheld == {Withheld.NO_SCALE: 10, Withheld.NO_VELOCITY: 2}
    assert out.sent == len(poses(told)) == len(path) - 12
    assert {word.reset_counter for word in poses(told)} == {0}


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"telemetry": {"devices": {"imu": {"kind": "mavlink", "external_pressure": None,
         "messages": ["ATTITUDE"], "link": {"kind": "udp", "port": 14550}}}}},
        {"fusion": {"enabled": False}, "telemetry": {"devices": {"dvl": {
         "kind": "waterlinked_json", "link": {"kind": "tcp", "host": "x", "port": 1}}}}},
    ],
    ids=["no telemetry", "attitude only", "no fusion"],
)  # fmt: skip
def test_a_service_that_can_never_know_metres_is_refused(
    settings: dict[str, Any], told: Told, tmp_path: Path
) -> None:
    vehicle = VehicleConfig.model_validate({"service": {"pose": {"enabled": True}}} | settings)
    with pytest.raises(ConfigError, match="metres"):
        map_live(told.feed, vehicle, tmp_path / "never")
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize(
    "device",
    [
        {"kind": "mavlink", "link": {"kind": "udp", "port": 14550}},
        {"kind": "dbc", "link": {"kind": "can", "interface": "virtual", "channel": "0"},
         "database": "rov.dbc",
         "samples": [{"message": "m", "sample": "depth", "signals": ["d"]}]},
    ],
    ids=["autopilot", "can"],
)  # fmt: skip
def test_a_depth_sensor_is_enough_to_start(device: dict[str, Any]) -> None:
    telemetry = {"devices": {"depth": device}}
    refuse_without_scale(VehicleConfig.model_validate({"telemetry": telemetry}))


@pytest.mark.parametrize(
    "fusion",
    [
        {"boards": [{"kind": "markers", "dictionary": "4X4_50", "marker_m": 0.1}]},
        {"lasers": {"colour": "red", "spacing_m": 0.1}},
    ],
    ids=["boards", "lasers"],
)
def test_a_known_length_is_enough_to_start(fusion: dict[str, Any]) -> None:
    refuse_without_scale(VehicleConfig.model_validate({"fusion": fusion}))


def test_a_correction_of_the_maps_place_that_is_small_makes_no_velocity_and_no_reset(
    told: Told,
) -> None:
    known = frame()
    out = PoseOutput(PoseConfig(), told.feed, lambda sub_map: known)
    for k, pose in enumerate(diving(SECONDS)):
        known = turned(frame(), [0.1, 0, 0, 0, 0, 0.02, 0]) if k >= 10 else known
        show(told, out, seen(pose, frame()))
    assert {word.reset_counter for word in poses(told)} == {0}
    speeds = [word.velocity_m_s for word in poses(told)]
    assert np.allclose(speeds, [0.5, 0.0, 0.275], atol=2e-3)


@pytest.mark.parametrize(
    "xi", [[0.3, 0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.1, 0]], ids=["moved", "turned"]
)
def test_a_correction_that_is_large_bumps_the_reset_counter_and_begins_the_velocity_anew(
    told: Told, xi: list[float]
) -> None:
    known = frame()
    out = PoseOutput(PoseConfig(), told.feed, lambda sub_map: known)
    for k, pose in enumerate(diving(SECONDS)):
        known = turned(frame(), xi) if k >= 10 else known
        show(told, out, seen(pose, frame()))
    assert [word.reset_counter for word in poses(told)] == [0] * 8 + [1] * 9
    assert json.loads(json.dumps(out.to_json()))["jumps"] == 1
    assert out.withheld == {Withheld.TOO_RARE: 1, Withheld.NO_VELOCITY: 3}
    speeds = [word.velocity_m_s for word in poses(told)]
    assert np.allclose(speeds, [0.5, 0.0, 0.275], atol=2e-3)


def test_a_loop_closure_that_moves_the_camera_in_the_map_is_a_jump(told: Told) -> None:
    out, known = output(told, frame()), frame()
    for k, pose in enumerate(diving(SECONDS)):
        T = seen(pose, known)
        show(told, out, Sim3(T.R, T.t + ASIDE, T.scale) if k >= 10 else T)
    assert [word.reset_counter for word in poses(told)] == [0] * 8 + [1] * 9


def test_a_merge_that_leaves_the_pose_where_it_was_is_no_jump(told: Told) -> None:
    out, known = output(told, frame()), frame()
    for k, pose in enumerate(diving(SECONDS)):
        show(told, out, seen(pose, known), sub_map=int(k < 10))
    assert {word.reset_counter for word in poses(told)} == {0}


def test_another_sub_map_after_a_loss_is_a_jump(told: Told) -> None:
    out, known = output(told, frame()), frame()
    for k, pose in enumerate(diving(SECONDS)):
        late_ns = 0 if k < 10 else 5_000_000_000
        t_ns = round(k * 1e8) + late_ns
        show(told, out, seen(pose, known), t_ns=t_ns, sub_map=int(k >= 10))
    assert [word.reset_counter for word in poses(told)] == [0] * 8 + [1] * 9


def test_the_same_sub_map_after_a_loss_is_none(told: Told) -> None:
    out, known = output(told, frame()), frame()
    for k, pose in enumerate(diving(SECONDS)):
        t_ns = round(k * 1e8) + (0 if k < 10 else 5_000_000_000)
        show(told, out, seen(pose, known), t_ns=t_ns)
    assert {word.reset_counter for word in poses(told)} == {0}
    assert out.withheld == {Withheld.TOO_RARE: 1, Withheld.NO_VELOCITY: 3}


def test_the_covariance_holds_the_frames_own_and_grows_with_the_way(told: Told) -> None:
    known = frame()
    dive(told, output(told, known), known)
    first, last = poses(told)[0].covariance, poses(told)[-1].covariance
    own = known.position_covariance(poses(told)[-1].t_m)
    assert np.all(np.diag(last)[:3] > np.diag(own))
    assert last[0, 0] - known.position_covariance(poses(told)[-1].t_m)[0, 0] > (
        first[0, 0] - known.position_covariance(poses(told)[0].t_m)[0, 0]
    )
    assert np.sqrt(last[5, 5]) == pytest.approx(np.hypot(0.02, 0.01 / 0.8))
    assert np.sqrt(last[3, 3]) == pytest.approx(np.hypot(0.005, 0.01 / 0.8))


def test_the_velocitys_covariance_covers_noise_of_the_poses(told: Told) -> None:
    rng, known = np.random.default_rng(3), frame()
    out = output(told, known)
    for pose in diving(np.arange(400) / 10.0):
        T = seen(replace(pose, t_m=pose.t_m + rng.normal(0.0, 0.01, 3)), known)
        show(told, out, T, quality=1.0)
    errors = np.array([word.velocity_m_s - [0.5, 0.0, 0.275] for word in poses(told)])
    covariances = np.array([word.motion_covariance[:3, :3] for word in poses(told)])
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    assert 0.05 < np.mean(squares) / 3.0 < 1.5


def test_poses_that_come_too_rarely_are_withheld(told: Told) -> None:
    known = frame()
    out = output(told, known)
    for pose in diving(SECONDS[::5]):
        show(told, out, seen(pose, known), hz=2.0)
    assert poses(told) == []
    assert out.withheld == {Withheld.TOO_RARE: 5}


def test_motions_are_in_the_axes_of_the_body_and_never_span_a_jump(told: Told) -> None:
    known = frame("down")
    out = output(told, known, message="vision_position_delta")
    path = diving(SECONDS)
    for k, pose in enumerate(path):
        T = seen(pose, known, "down")
        show(told, out, Sim3(T.R, T.t + ASIDE, T.scale) if k >= 10 else T)
    motions = [word for word in told.feed.told if isinstance(word, BodyPoseChange)]
    assert len(motions) == len(path) - 2
    step = path[4].R.T @ (path[4].t_m - path[3].t_m)
    for motion in motions:
        assert np.allclose(motion.translation_m, step, atol=1e-9)
        assert np.allclose(motion.rotation, so3_log(path[3].R.T @ path[4].R), atol=1e-9)
        assert motion.since_ns == 100_000_000


def test_motions_need_metres_too_but_no_gravity(told: Told) -> None:
    known = replace(frame(), level=False)
    out = output(told, known, message="vision_position_delta")
    dive(told, out, known)
    assert out.sent == len(SECONDS) - 1
    blind = output(told, WorldFrame.unknown(), message="vision_position_delta")
    dive(told, blind, known)
    assert blind.withheld == {Withheld.NO_SCALE: len(SECONDS)}


def test_stamps_of_a_resumed_dive_are_those_of_this_boots_clock(told: Told) -> None:
    told.feed.continue_from(Continued(100, 7_000_000_000))
    known = frame()
    dive(told, output(told, known), known)
    assert poses(told)[-1].t_ns == 2_000_000_000 - 7_000_000_000


def test_the_report_of_a_live_dive_holds_the_poses(tmp_path: Path) -> None:
    feed = ToldFeed()
    with LiveDive("told", Choice(tmp_path / "dive"), feed, VEHICLE) as dive:
        out = PoseOutput(PoseConfig(), feed, dive.parts.slam.metric_frame)
        dive.parts.loop.watchers.append(out.update)
        for k, pose in enumerate(diving(SECONDS[:5])):
            tracked = Tracked(frame_of(k), FrameClass.COMMON, 0, 0, seen(pose, frame()))
            dive.parts.loop.latest = tracked
            dive.parts.loop.take(None)
        said = json.loads(json.dumps(report(dive.parts, 60.0, out)))
        assert said["pose_output"]["withheld"] == {Withheld.NO_SCALE.value: 5}
        assert said["pose_output"]["scale"].startswith("none")
        assert report(dive.parts, 60.0)["pose_output"] is None


def test_a_service_with_a_source_of_metres_starts_with_its_poses_switched_on(
    tmp_path: Path,
) -> None:
    settings = VEHICLE.model_dump()
    settings["service"]["pose"]["enabled"] = True
    devices = {"autopilot": {"kind": "mavlink", "link": {"kind": "udp", "port": 14550}}}
    settings["telemetry"] = {"devices": devices}
    feed = ToldFeed()
    feed.newest.end()
    assert map_live(feed, VehicleConfig.model_validate(settings), tmp_path / "dive") is None
