"""What goes back to the vehicle: sentences, numbers, and poses that it may steer by."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.config.service import PoseConfig
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.errors import ConfigError
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.service.vehicle.pilot_messages import PilotMessages
from aquaflow.service.vehicle.pose_output import MetricScale, PoseOutput
from aquaflow.sources.outbound import BodyMotion, BodyPose, NamedValue, OutboundMessage, StatusText
from aquaflow.tracking.frames import FrameClass, Quality, Tracked
from drivers.protocol.mavlink import MavlinkDecoder
from tests.service.live_scenes import Told, frame_of

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

METRES = MetricScale(2.0, "test", 0.05)


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    told = Told(tmp_path / "dive")
    yield told
    told.close()


def swim(told: Told, pose: PoseOutput, xs: list[float], hz: float = 10.0, sub_map: int = 0) -> None:
    """Poses whose camera moves forward, from 1000 s on."""
    for x in xs:
        index = told.loop.counters.frames
        told.loop.counters.frame(0)
        T = Sim3(np.eye(3), np.array([0.0, 0.0, x]))
        quality = Quality(inlier_share=0.8)
        told.loop.latest = Tracked(frame_of(index), FrameClass.COMMON, sub_map, 0, T, quality)
        pose.update(told.loop, 1000.0 + index / hz)


def poses(told: Told) -> list[BodyPose]:
    return [word for word in told.feed.told if isinstance(word, BodyPose)]


def test_without_metres_no_pose_steers_a_vehicle(told: Told) -> None:
    with pytest.raises(ConfigError, match="metres"):
        PoseOutput(PoseConfig(enabled=True), told.feed, None)


def test_poses_are_in_metres_forward_right_down(told: Told) -> None:
    swim(told, PoseOutput(PoseConfig(), told.feed, METRES), [0.0, 0.01, 0.02])
    assert [list(word.t_m) for word in poses(told)] == [[0.02, 0, 0], [0.04, 0, 0]]
    assert np.allclose(poses(told)[0].R, np.eye(3))
    assert {word.quality for word in poses(told)} == {0.8}


def test_the_covariance_grows_with_the_way(told: Told) -> None:
    swim(told, PoseOutput(PoseConfig(), told.feed, METRES), [0.05 * i for i in range(60)])
    sigmas = [float(word.covariance[0, 0]) for word in poses(told)]
    assert sigmas == sorted(sigmas)
    assert sigmas[-1] > 5 * sigmas[0]


def test_a_jump_bumps_the_reset_counter_and_so_does_another_sub_map(told: Told) -> None:
    out = PoseOutput(PoseConfig(), told.feed, METRES)
    swim(told, out, [0.0, 0.01, 0.5, 0.51])
    swim(told, out, [0.52], sub_map=1)
    assert [word.reset_counter for word in poses(told)] == [0, 1, 1, 2]


def test_poses_that_come_too_rarely_are_withheld(told: Told) -> None:
    out = PoseOutput(PoseConfig(), told.feed, METRES)
    swim(told, out, [0.01 * i for i in range(5)], hz=2.0)
    assert poses(told) == []
    assert out.withheld == 5


def test_motion_is_told_between_poses_and_never_over_a_jump(told: Told) -> None:
    out = PoseOutput(PoseConfig(message="vision_position_delta"), told.feed, METRES)
    swim(told, out, [0.0, 0.01, 0.5, 0.51])
    motions = [word for word in told.feed.told if isinstance(word, BodyMotion)]
    assert [round(float(m.translation_m[0]), 3) for m in motions] == [0.02, 0.02]
    assert {m.since_ns for m in motions} == {100_000_000}


def test_the_pilot_hears_of_changes_and_numbers_come_once_a_second(told: Told) -> None:
    report = PilotMessages(told.config.report, told.feed)
    told.frames("pp")
    for tenth in range(31):
        report.update(told.loop, tenth / 10)
    sentences = [word for word in told.feed.told if isinstance(word, StatusText)]
    assert [word.text for word in sentences] == ["AquaFlow tracking: every frame has a pose"]
    numbers = [word.name for word in told.feed.told if isinstance(word, NamedValue)]
    assert numbers.count("AQ_STATE") == 4


# --- on the wire ----------------------------------------------------------------------------------


def heard(*words: OutboundMessage, talk: bool = True) -> list[Any]:
    """What an autopilot reads."""
    link = {"kind": "udp", "port": 14550}
    device = {"kind": "mavlink", "talk": talk, "link": link}
    config = parse_telemetry({"devices": {"autopilot": device}}, "test").devices["autopilot"]
    decoder = MavlinkDecoder("autopilot", config)  # type: ignore[arg-type]
    for word in words:
        assert decoder.send(word) is talk
    dialect: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
    wire = dialect.MAVLink(None)
    messages = wire.parse_buffer(decoder.outgoing(5_000_000_000)) or []
    return [m for m in messages if m.get_type() not in ("HEARTBEAT", "TIMESYNC")]


def body(R: np.ndarray | None = None, x: float = 1.5) -> BodyPose:
    rotation = so3_exp(np.array([0.0, 0.0, 0.3])) if R is None else R
    return BodyPose(7_000_000, rotation, np.array([x, 0.0, -2.0]), 0.01 * np.eye(6), 0.9, 257)


def test_every_word_arrives_as_its_message() -> None:
    motion = BodyMotion(7_000_000, 100_000_000, np.array([0, 0, 0.1]), np.array([1.0, 0, 0]), 0.5)
    number, sentence = NamedValue(7_000_000, "AQ_STATE", 3.0), StatusText("warning", "é" + "x" * 80)
    text, value, pose, delta = heard(sentence, number, body(), motion)
    assert (text.severity, text.text) == (4, "?" + "x" * 49)
    assert (value.name, value.value) == ("AQ_STATE", 3.0)
    assert (pose.x, pose.z, pose.reset_counter, pose.quality) == (1.5, -2.0, 1, 90)
    assert pose.q == pytest.approx([np.cos(0.15), 0.0, 0.0, np.sin(0.15)], abs=1e-6)
    assert pose.pose_covariance[0] == pose.pose_covariance[20] == pytest.approx(0.01)
    assert (delta.time_delta_usec, delta.confidence) == (100_000, 50.0)


def test_a_pose_that_is_not_finite_is_not_sent() -> None:
    assert heard(body(R=np.full((3, 3), np.nan)), body(x=float("nan")), body(x=1e9)) == []


def test_a_link_that_only_listens_says_nothing() -> None:
    assert heard(StatusText("info", "hello"), talk=False) == []
