"""The recorder: what goes in comes out, and nothing makes a driver wait."""

from __future__ import annotations

import errno
import json
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.service import RecordingConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.port import FlatPort
from aquaflow.live.recorder import Recorder, RecorderStatus, dive_file
from aquaflow.live.recorder.dive_file import DiveFile
from aquaflow.live.recorder.session import RecordingSession
from aquaflow.live.recorder.writing import encode
from aquaflow.recordings import mcap_messages
from aquaflow.recordings.mcap_camera import McapCamera
from aquaflow.recordings.mcap_messages import McapMessages, mcap_files
from aquaflow.recordings.mcap_telemetry import McapTelemetry
from aquaflow.recordings.playback import Playback
from aquaflow.sources import mounting_of
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Dropped,
    EncodedPicture,
    Frame,
    Lights,
    Position,
    TelemetrySample,
    UtcTime,
    Velocity,
)
from tests.recordings.simulated_time import SimulatedTime, simulated, written
from tests.small_recording import GIVE_UP_S

SECOND = 1_000_000_000
CAMERA = CameraModel(
    64, 48, 50.1, 50.2, 31.7, 24.3, "radtan", (0.1, -0.02, 1e-3, 1 / 3), FlatPort(0.05, 1 / 300)
)
LOSSLESS = RecordingConfig(picture="png", reserve_mb=0)
BIG_MB = 10**9


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimulatedTime:
    return simulated(monkeypatch)


def picture(index: int, **more: object) -> Frame:
    image = np.random.default_rng(index).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    t_ns = 5 * SECOND + index * SECOND // 30
    return replace(Frame(index, t_ns, t_ns + 2_000_000, image, CAMERA), **more)  # type: ignore[arg-type]


def samples() -> list[TelemetrySample]:
    third = 1.0 / 3.0
    stamp = (5 * SECOND, 5 * SECOND + 7, "rov/x")
    return [
        Depth(*stamp, third),
        Attitude(*stamp, (0.5, -0.5, third, 1e-17)),
        AngularRate(*stamp, (third, 0.0, -1e9)),
        Acceleration(*stamp, (9.81, third, -0.0)),
        Velocity(*stamp, (1.0, 2.0, third), 0.01),
        Altitude(*stamp, third),
        Lights(*stamp, 0.25),
        Position(*stamp, -41.0 - third, 174.8, third),
        UtcTime(*stamp, 1_795_365_000_123_456_789),
    ]


def recorded(out: Path, frames: list[Frame | Dropped], settings: RecordingConfig) -> McapCamera:
    recorder = Recorder(out, settings)
    for frame in frames:
        recorder.frame("c", frame)
    assert recorder.close().stopped is None
    return McapCamera(out)


def test_a_port_that_an_old_recording_only_names_is_left_out_with_a_note(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unmeasured = {"thickness_m": 0.0, "distance_m": 0.0, "refractive_index_glass": 1.49}
    port = {"kind": "dome", **unmeasured, "refractive_index_water": 1.34}
    monkeypatch.setattr(
        "aquaflow.live.recorder.writing.camera_to_json",
        lambda camera: json.dumps(asdict(camera) | {"port": port}),
    )
    camera = recorded(tmp_path, [picture(0)], LOSSLESS)
    assert camera.camera == replace(CAMERA, port=None)
    list(camera.frames())
    assert any("names a dome port without its measures" in note for note in camera.notes)


@pytest.mark.parametrize("kind", ["png", "raw"])
def test_pictures_come_back_bit_for_bit(tmp_path: Path, kind: str) -> None:
    mask = np.zeros((48, 64), bool)
    mask[10:] = True
    given = [picture(0), picture(3, exposure_s=0.004, gain=2.5), picture(4, mask=mask)]
    settings = RecordingConfig.model_validate({"picture": kind, "reserve_mb": 0})
    camera = recorded(tmp_path, [*given], settings)
    assert camera.camera == CAMERA
    assert camera.frame_count == 3
    for before, after in zip(given, camera.frames(), strict=True):
        assert isinstance(after, Frame)
        assert after.index == before.index
        assert after.t_ns == before.t_ns - given[0].t_ns
        assert after.arrival_ns == before.arrival_ns - given[0].t_ns
        assert (after.exposure_s, after.gain) == (before.exposure_s, before.gain)
        assert np.array_equal(after.image, before.image)
        assert (after.mask is None) == (before.mask is None)
    assert after.mask is not None
    assert np.array_equal(after.mask, mask)


def test_received_bytes_are_kept_as_they_are_unless_told_otherwise(tmp_path: Path) -> None:
    jpeg = encode(picture(0).image, RecordingConfig(jpeg_quality=50))
    for keep in (True, False):
        settings = RecordingConfig(keep_received=keep, reserve_mb=0)
        given = picture(0, encoded=jpeg)
        camera = recorded(tmp_path / str(keep), [given], settings)
        (frame,) = camera.frames()
        assert isinstance(frame, Frame)
        assert frame.encoded is not None
        assert (frame.encoded == jpeg) is keep


def test_missing_pictures_keep_their_place(tmp_path: Path) -> None:
    given = [Dropped(0, 4 * SECOND, "black"), picture(1), Dropped(2, 6 * SECOND, "torn")]
    camera = recorded(tmp_path, given, LOSSLESS)
    first, second, third = camera.frames()
    assert (first, third) == (Dropped(0, 0, "black"), Dropped(2, 2 * SECOND, "torn"))
    assert second.t_ns == given[1].t_ns - 4 * SECOND


def test_how_a_camera_is_mounted_comes_back_from_every_file(tmp_path: Path) -> None:
    recorder, down = Recorder(tmp_path, LOSSLESS), MountingConfig(pitch_deg=-90.1)
    recorder.record_mounting("c", down)
    recorder.record_mounting("other", None)
    recorder.frame("c", picture(0))
    recorder.frame("other", picture(0))
    recorder.close()
    assert mounting_of(McapCamera(tmp_path, "c")) == down
    assert mounting_of(McapCamera(tmp_path, "other")) is None


def test_a_damaged_mounting_is_refused_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = recorded(tmp_path, [picture(0)], LOSSLESS)
    monkeypatch.setitem(camera._messages.facts["camera:c"], "mounting", '{"pitch": 1}')
    with pytest.raises(InputError, match=r"mounting.*fusion\.camera"):
        mounting_of(camera)
    session = RecordingSession(Recorder(tmp_path / "again", LOSSLESS))
    session.add_playback("c", Playback(camera, []), [])
    session.run()
    assert session.recorder.status.frames == 1
    assert "mounting" in session.notes[0]


def test_samples_of_every_kind_keep_every_bit(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, LOSSLESS)
    for sample in samples():
        recorder.sample(sample)
    assert recorder.close().samples == len(samples())
    assert list(McapTelemetry(tmp_path, origin_ns=0).samples()) == samples()


def test_a_sample_that_is_not_finite_costs_itself_and_is_counted(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, LOSSLESS)
    recorder.sample(Depth(0, 0, "a", float("nan")))
    recorder.sample(Depth(0, 0, "a", 1.0))
    status = recorder.close()
    assert (status.samples, status.dropped) == (1, {"/telemetry/a": 1})


def test_bytes_of_links_are_kept_as_they_came(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, LOSSLESS)
    reads = [("dvl", 10, b"wrz,\x00\xff"), ("auv", 20, b""), ("dvl", 30, bytes(range(256)))]
    for read in reads:
        recorder.raw(*read)
    recorder.close()
    assert [read[:3] for read in McapTelemetry(tmp_path, origin_ns=0).link_bytes()] == reads


def test_times_in_the_file_are_arrival_and_exposure(tmp_path: Path) -> None:
    recorded(tmp_path, [picture(7)], LOSSLESS)
    (message,) = McapMessages(mcap_files(tmp_path)).of(lambda topic: topic == "/c/image")
    assert message.schema is not None
    assert message.schema.name == "foxglove.CompressedImage"
    assert message.log_ns == picture(7).arrival_ns
    assert (message.publish_ns, message.number) == (picture(7).t_ns, 7)


def test_the_wall_clock_is_a_series_beside_the_monotonic_one(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, LOSSLESS)
    recorder.close()
    clocks = list(McapMessages(mcap_files(tmp_path)).of(lambda topic: topic == "/clock"))
    assert clocks
    assert all(message.log_ns <= time.monotonic_ns() for message in clocks)


@pytest.mark.parametrize("limits", [{"file_mb": 1}, {"file_s": 0.1}])
def test_every_file_of_a_long_recording_stands_alone(
    tmp_path: Path, limits: dict[str, float], clock: SimulatedTime
) -> None:
    settings = RecordingConfig(picture="raw", reserve_mb=0, chunk_kb=16, flush_s=0.05, **limits)
    recorder = Recorder(tmp_path, settings)
    for index in range(150):
        recorder.frame("c", picture(index))
        written(recorder, index + 1)
        clock.now_s += 0.001
    status = recorder.close()
    assert len(status.files) > 1
    alone = [McapCamera(file) for file in status.files if "image" in str(topics(file))]
    assert all(camera.camera == CAMERA for camera in alone)
    indices = [frame.index for camera in alone for frame in camera.frames()]
    assert indices == list(range(150))
    assert [frame.index for frame in McapCamera(tmp_path).frames()] == indices


def topics(file: Path) -> set[str]:
    return {message.topic for message in McapMessages([file])}


def test_a_video_goes_on_in_a_new_file_only_with_a_key_frame(
    tmp_path: Path, clock: SimulatedTime
) -> None:
    settings = RecordingConfig(reserve_mb=0, file_s=0.02, flush_s=0.01)
    recorder = Recorder(tmp_path, settings)
    for index in range(60):
        unit = EncodedPicture("h264", bytes([index]), key=index % 10 == 0)
        recorder.frame("c", picture(index, encoded=unit))
        written(recorder, index + 1)
        clock.now_s += 0.004
    files = recorder.close().files
    assert len(files) > 2
    firsts = [
        next(iter(McapMessages([file]).of(lambda topic: topic == "/c/video")), None)
        for file in files
    ]
    assert all(first.number % 10 == 0 for first in firsts if first is not None)


def test_a_slow_disk_costs_messages_that_are_counted_and_never_a_drivers_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck, release = threading.Event(), threading.Event()

    def slow_flush(self: DiveFile) -> None:
        stuck.set()
        release.wait(GIVE_UP_S)

    monkeypatch.setattr(dive_file.DiveFile, "flush", slow_flush)
    recorder = Recorder(tmp_path, RecordingConfig(queue_mb=1, reserve_mb=0))
    assert stuck.wait(GIVE_UP_S)
    for index in range(200):
        recorder.frame("c", picture(index))  # 9 kB each; would hang here if it waited
    waiting = recorder.status.frames
    release.set()
    status = recorder.close()
    assert waiting == 0
    assert status.dropped["/c"] > 50
    assert status.frames == 200 - status.dropped["/c"] >= 1_000_000 // 10_000


def test_recording_stops_before_the_disk_is_full_and_says_so(tmp_path: Path) -> None:
    left = iter([3000, 2000] + [900] * 1000)

    def free(folder: Path) -> int:
        return next(left) * 1_000_000

    recorder = Recorder(tmp_path, RecordingConfig(reserve_mb=1000, flush_s=0.02), free)
    deadline = time.monotonic() + GIVE_UP_S
    index = 0
    while recorder.status.stopped is None and time.monotonic() < deadline:
        recorder.frame("c", picture(index))
        index += 1
        time.sleep(0.002)
    recorder.frame("c", picture(index))
    status = recorder.close()
    assert status.stopped is not None
    assert "900 MB left" in status.stopped
    # The file is whole: it has its index.
    assert McapMessages(mcap_files(tmp_path)).counts is not None
    assert not list(McapCamera(tmp_path).notes)


def test_a_full_disk_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="MB are kept free"):
        Recorder(tmp_path, RecordingConfig(reserve_mb=BIG_MB))


def test_a_disk_that_takes_no_more_ends_the_recording_with_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_space(self: DiveFile) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(dive_file.DiveFile, "flush", no_space)
    recorder = Recorder(tmp_path, RecordingConfig(reserve_mb=0))
    recorder.frame("c", picture(0))
    status: RecorderStatus = recorder.close()
    assert status.stopped == "the disk takes no more: No space left on device"


def test_a_recording_is_never_written_over(tmp_path: Path) -> None:
    Recorder(tmp_path, LOSSLESS).close()
    with pytest.raises(InputError, match="already holds a recording"):
        Recorder(tmp_path, LOSSLESS)


def test_a_missing_extra_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_messages, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'aquaflow\[recording\]'"):
        Recorder(tmp_path, LOSSLESS)
