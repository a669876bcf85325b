"""What goes back to the vehicle: sentences, numbers, and poses as they are on the wire."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.config.telemetry import parse_telemetry
from aquaflow.drivers.protocol.mavlink import MavlinkDecoder
from aquaflow.drivers.protocol.mavlink_outbound import ARDUPILOT, MOST_CHUNKS
from aquaflow.geometry.similarity import so3_exp
from aquaflow.live.vehicle.arming import PilotMessages
from aquaflow.sources.outbound import (
    LONGEST_TEXT,
    BodyPose,
    BodyPoseChange,
    NamedValue,
    OutboundMessage,
    StatusText,
)
from tests.live.live_scenes import Told

pytest.importorskip("pymavlink", reason="pymavlink is not installed")


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    told = Told(tmp_path / "dive")
    yield told
    told.close()


def test_the_pilot_hears_of_changes_and_numbers_come_once_a_second(told: Told) -> None:
    report = PilotMessages(told.config.report, told.feed)
    told.frames("pp")
    for tenth in range(31):
        report.update(told.loop, tenth / 10)
    sentences = [word for word in told.feed.told if isinstance(word, StatusText)]
    assert [word.text for word in sentences] == ["AquaFlow is tracking."]
    numbers = [word.name for word in told.feed.told if isinstance(word, NamedValue)]
    assert numbers.count("AQ_STATE") == 4


# --- on the wire ----------------------------------------------------------------------------------

PX4 = 12
"""MAV_AUTOPILOT_PX4."""


def heard(
    *words: OutboundMessage, talk: bool = True, autopilot: int | None = ARDUPILOT
) -> list[Any]:
    """What an autopilot reads whose heartbeats say what it is and whose clock is known; without
    ``autopilot``, nothing of it is."""
    dialect: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
    link = {"kind": "udp", "port": 14550}
    device = {"kind": "mavlink", "talk": talk, "link": link}
    config = parse_telemetry({"devices": {"autopilot": device}}, "test").devices["autopilot"]
    decoder = MavlinkDecoder("autopilot", config)  # type: ignore[arg-type]
    if autopilot is not None:
        vehicle = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        beat = dialect.MAVLink_heartbeat_message(12, autopilot, 0, 0, 4, 3).pack(vehicle)
        clock = dialect.MAVLink_system_time_message(0, 2_000).pack(vehicle)
        decoder.feed(bytes(beat) + bytes(clock), 5_000_000_000)
    for word in words:
        assert decoder.send(word) is talk
    wire = dialect.MAVLink(None)
    messages = wire.parse_buffer(decoder.outgoing(5_000_000_000)) or []
    return [m for m in messages if m.get_type() not in ("HEARTBEAT", "TIMESYNC")]


def body(R: np.ndarray | None = None, x: float = 1.5, north: bool = False) -> BodyPose:
    rotation = so3_exp(np.array([0.0, 0.0, 0.3])) if R is None else R
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + 0.1
    return BodyPose(
        4_900_000_000, rotation, np.array([x, 0.0, -2.0]), covariance,
        np.array([0.5, 0.0, 0.25]), np.array([0.0, 0.1, 0.3]), 2.0 * covariance, 0.9, 257, north,
    )  # fmt: skip


MOTION = BodyPoseChange(
    4_900_000_000, 100_000_000, np.array([0, 0, 0.1]), np.array([1.0, 0, 0]), 0.5
)


def test_every_word_arrives_as_its_message() -> None:
    number = NamedValue(4_900_000_000, "AQ_STATE", 3.0)
    sentence = StatusText("warning", "é" + "x" * 49)
    text, value, pose, delta = heard(sentence, number, body(), MOTION)
    assert (text.severity, text.text, text.id) == (4, "?" + "x" * 49, 0)
    assert (value.name, value.value) == ("AQ_STATE", 3.0)
    assert (pose.x, pose.z, pose.reset_counter, pose.quality) == (1.5, -2.0, 1, 90)
    assert pose.q == pytest.approx([np.cos(0.15), 0.0, 0.0, np.sin(0.15)], abs=1e-6)
    assert (pose.vx, pose.vz) == (0.5, 0.25)
    assert [pose.rollspeed, pose.pitchspeed, pose.yawspeed] == pytest.approx([0.0, 0.1, 0.3])
    diagonal = [0, 6, 11, 15, 18, 20]
    upper, twice = pose.pose_covariance, pose.velocity_covariance
    assert [upper[i] for i in diagonal] == pytest.approx([1.1, 2.1, 3.1, 4.1, 5.1, 6.1])
    assert [upper[i] for i in range(21) if i not in diagonal] == pytest.approx([0.1] * 15)
    assert twice == pytest.approx([2.0 * each for each in upper])
    assert (delta.time_delta_usec, delta.confidence) == (100_000, 50.0)


@pytest.mark.parametrize("length", [51, 99, 100, 101, 150, 249])
def test_a_long_text_comes_in_chunks_that_make_it_whole(length: int) -> None:
    words = [StatusText("info", letter * length) for letter in "ab"]
    chunks = heard(*words)
    for letter in "ab":
        of_one = [chunk for chunk in chunks if chunk.text.startswith(letter)]
        assert "".join(chunk.text for chunk in of_one) == letter * length
    numbers = list(dict.fromkeys(chunk.id for chunk in chunks))
    assert len(numbers) == 2
    assert 0 not in numbers
    for number in numbers:
        of_one = [chunk for chunk in chunks if chunk.id == number]
        assert [chunk.chunk_seq for chunk in of_one] == list(range(len(of_one)))
        assert all(len(chunk.text) == LONGEST_TEXT for chunk in of_one[:-1])
        assert len(of_one[-1].text) < LONGEST_TEXT  # a null character ends the text


def test_a_text_without_end_is_cut() -> None:
    chunks = heard(StatusText("info", "x" * 10_000))
    assert sum(len(chunk.text) for chunk in chunks) == MOST_CHUNKS * LONGEST_TEXT - 1


def test_stamps_are_of_the_autopilots_clock() -> None:
    pose, delta = heard(body(), MOTION)
    assert pose.time_usec == delta.time_usec == 1_900_000


def test_no_pose_goes_to_an_autopilot_whose_clock_is_unknown() -> None:
    (value,) = heard(body(), MOTION, NamedValue(4_900_000_000, "AQ_STATE", 3.0), autopilot=None)
    assert value.get_type() == "NAMED_VALUE_FLOAT"


@pytest.mark.parametrize(
    ("autopilot", "north", "frame"),
    [(ARDUPILOT, True, 20), (ARDUPILOT, False, 20), (PX4, True, 1), (PX4, False, 20)],
)
def test_a_frame_is_named_after_north_where_the_autopilot_reads_that(
    autopilot: int, north: bool, frame: int
) -> None:
    (pose,) = heard(body(north=north), autopilot=autopilot)
    assert (pose.frame_id, pose.child_frame_id) == (frame, 12)


def test_a_pose_that_is_poor_says_so_and_never_that_its_quality_is_unknown() -> None:
    (pose,) = heard(replace(body(), quality=0.001))
    assert pose.quality == 1


def test_a_pose_that_is_not_finite_is_not_sent() -> None:
    blind = replace(body(), velocity_m_s=np.full(3, np.nan))
    poor = replace(MOTION, rotation=np.full(3, np.nan))
    turned = body(R=np.full((3, 3), np.nan))
    assert heard(turned, body(x=float("nan")), body(x=1e9), blind, poor) == []


def test_a_link_that_only_listens_says_nothing() -> None:
    assert heard(StatusText("info", "hello"), talk=False) == []
