"""What is left of a recording that ended without being asked."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from aquaflow.config.service import RecordingConfig
from aquaflow.geometry.camera import guess_camera
from aquaflow.live.recorder import Recorder
from aquaflow.recordings.mcap_camera import McapCamera
from aquaflow.recordings.mcap_telemetry import McapTelemetry
from aquaflow.types import Depth, Dropped, Frame
from tests.recordings.killed import FPS, Killed, record_and_kill, write_source
from tests.recordings.simulated_time import simulated, written

FRAMES = 40


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished file of small chunks, four pictures each."""
    folder = tmp_path_factory.mktemp("whole")
    recorder = Recorder(folder, RecordingConfig(picture="raw", chunk_kb=32, reserve_mb=0))
    for k in range(FRAMES):
        image = np.full((48, 64, 3), k, np.uint8)
        recorder.frame("c", Frame(k, k * 10**7, k * 10**7, image, guess_camera(64, 48)))
        recorder.sample(Depth(k * 10**7, k * 10**7, "d", float(k)))
    return recorder.close().files[0]


def replayed(data: bytes, folder: Path) -> tuple[list[int], list[float], list[str]]:
    """Pictures by the grey they show, depths, and notes."""
    folder.mkdir()
    (folder / "cut.mcap").write_bytes(data)
    camera, telemetry = McapCamera(folder), McapTelemetry(folder, origin_ns=0)
    frames = [frame for frame in camera.frames() if isinstance(frame, Frame)]
    depths = [sample.depth_m for sample in telemetry.samples() if isinstance(sample, Depth)]
    return [int(frame.image[0, 0, 0]) for frame in frames], depths, camera.notes


def test_a_file_cut_anywhere_replays_up_to_its_last_whole_chunk(
    whole: Path, tmp_path: Path
) -> None:
    data = whole.read_bytes()
    seen = set()
    for number, cut in enumerate(random.Random(0).sample(range(80_000, len(data) - 1), 25)):
        pictures, depths, notes = replayed(data[:cut], tmp_path / str(number))
        assert pictures == list(range(len(pictures)))
        assert abs(len(depths) - len(pictures)) <= 1
        assert notes == (["cut.mcap was cut off; all before its end is used"] if notes else [])
        # A chunk is closed as soon as it holds 32 kB: four pictures of 9 kB.
        assert len(pictures) * 48 * 64 * 3 > cut - 60_000
        seen.add(len(pictures))
    assert len(seen) > 5


def test_zeros_at_the_end_as_some_file_systems_leave_them_cost_nothing(
    whole: Path, tmp_path: Path
) -> None:
    data = whole.read_bytes()[:200_000]
    assert replayed(data, tmp_path / "a")[:2] == replayed(data + bytes(9999), tmp_path / "b")[:2]


def test_a_damaged_place_costs_its_chunk(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    data[150_000] ^= 1
    pictures, _, notes = replayed(bytes(data), tmp_path / "damaged")
    assert FRAMES - 5 <= len(pictures) < FRAMES
    assert pictures == sorted(pictures)
    assert notes == ["1 damaged chunks of cut.mcap were left out"]


@pytest.fixture(scope="module")
def small_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    write_source(folder, 30.0, 160, 120)
    return folder


def assert_all_that_is_there_replays(left: Killed) -> None:
    assert left.unreadable == 0
    assert left.pictures > 0
    assert left.samples > 0


def test_all_that_a_killed_recorder_wrote_replays(small_source: Path, tmp_path: Path) -> None:
    left = record_and_kill(small_source, tmp_path / "killed", after_s=0.0, begun_bytes=200_000)
    assert_all_that_is_there_replays(left)


def test_whenever_the_power_goes_at_most_the_last_second_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the disk has at a moment is what a kill at that moment leaves."""
    clock, live = simulated(monkeypatch), tmp_path / "live"
    recorder = Recorder(live, RecordingConfig(picture="raw", reserve_mb=0))
    for k in range(3 * FPS):
        image = np.full((48, 64, 3), k, np.uint8)
        recorder.frame("c", Frame(k, k * 10**7, k * 10**7, image, guess_camera(64, 48)))
        written(recorder, k + 1)
        if k >= FPS and k % 7 == 0:
            left = tmp_path / f"left after {k}"
            shutil.copytree(live, left)
            newest = max(frame.index for frame in McapCamera(left).frames())
            assert k - FPS < newest <= k
        clock.now_s += 1.0 / FPS
    recorder.close()


@pytest.mark.slow
def test_twenty_killed_recordings_of_a_minute_all_replay(tmp_path: Path) -> None:
    """640x480 at 30 pictures/s with telemetry, for a random time up to a minute each."""
    source = tmp_path / "source"
    write_source(source, 66.0, 640, 480)
    rng = random.Random(20)
    shares = []
    for k in range(20):
        left = record_and_kill(source, tmp_path / f"out{k}", rng.uniform(2.0, 60.0))
        assert_all_that_is_there_replays(left)
        assert left.lost_s < 1.0
        shares.append(left.cpu_share)
        assert left.pictures < 66 * FPS
    assert np.median(shares) < 0.3


def test_nothing_on_the_disk_but_the_start_is_said_in_one_sentence(
    whole: Path, tmp_path: Path
) -> None:
    (tmp_path / "a.mcap").write_bytes(whole.read_bytes()[:100])
    with pytest.raises(Exception, match="holds no picture"):
        McapCamera(tmp_path)


def test_a_recording_after_a_cut_one_is_read_on(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    (tmp_path / "0000.mcap").write_bytes(data[:150_000])
    (tmp_path / "0001.mcap").write_bytes(data)
    frames = list(McapCamera(tmp_path).frames())
    assert len(frames) > FRAMES
    assert not any(isinstance(frame, Dropped) for frame in frames)
