"""``aquaflow record`` as a user types it, and the session behind it."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.config.service import RecordingConfig
from aquaflow.config.telemetry import TelemetryConfig
from aquaflow.geometry.camera import guess_camera
from aquaflow.live.recorder import Recorder
from aquaflow.live.recorder import session as session_module
from aquaflow.live.recorder.session import RecordingSession
from aquaflow.recordings.mcap_camera import McapCamera
from aquaflow.recordings.mcap_messages import McapMessages, mcap_files
from aquaflow.recordings.mcap_telemetry import McapTelemetry
from aquaflow.sources import open_links
from aquaflow.types import Depth, Dropped, Frame, TelemetrySample, UtcTime
from tests.command_line import Cli, refused
from tests.recordings.killed import FPS, sentence, under_way, write_source
from tests.small_recording import GIVE_UP_S

HOUR_S = 3600.0


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    write_source(folder, 20.0, 64, 48)
    return folder


def test_a_recording_is_recorded_with_its_telemetry_and_its_bytes(
    aquaflow: Cli, tmp_path: Path
) -> None:
    out, source = tmp_path / "out", tmp_path / "source"
    write_source(source, 2.0, 64, 48)
    ran = aquaflow("record", "--source", source, "--out", out, "--json")
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    assert told["stopped"] is None
    assert told["dropped"] == {}
    telemetry = McapTelemetry(out)
    assert len(list(McapCamera(out).frames())) == told["frames"] == 2 * FPS
    assert len(list(telemetry.samples())) == told["samples"] > 0
    assert sum(len(read.data) for read in telemetry.link_bytes()) == told["link_bytes"] > 0
    assert told["files"] == [str(file) for file in mcap_files(out)]


def test_systemds_sigterm_ends_it_cleanly_with_one_line(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = Path(sys.executable).with_name("aquaflow")
    process = subprocess.Popen(
        [str(script), "record", "--source", str(source), "--out", str(out)],
        stdout=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + GIVE_UP_S
    while not under_way(out) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    printed, _ = process.communicate(timeout=GIVE_UP_S)
    assert process.returncode == 0
    (line,) = printed.splitlines()
    assert line.startswith("Recorded ")
    assert str(out) in line
    assert McapMessages(mcap_files(out)).counts is not None


def test_nothing_to_record_is_said(aquaflow: Cli, tmp_path: Path) -> None:
    refused(aquaflow("record", "--out", tmp_path / "out"), "--config", code=MISUSED)
    assert not (tmp_path / "out").exists()


def test_an_unknown_way_to_keep_pictures_is_refused(
    aquaflow: Cli, source: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    refused(
        aquaflow("record", "--source", source, "--out", out, "--picture", "gif"),
        "picture",
        code=MISUSED,
    )


def test_a_full_disk_is_an_error_and_not_a_summary(
    aquaflow: Cli, source: Path, tmp_path: Path
) -> None:
    config = tmp_path / "rov.yaml"
    config.write_text("recording: {reserve_mb: 1000000000}\n")
    out = tmp_path / "out"
    refused(aquaflow("record", "--source", source, "--config", config, "--out", out), out, "MB")


def test_a_missing_source_is_named(aquaflow: Cli, tmp_path: Path) -> None:
    refused(aquaflow("record", "--source", tmp_path / "no", "--out", tmp_path / "out"), "no")
    assert not (tmp_path / "out").exists()


class LiveCamera:
    """A device that delivers until it is closed."""

    camera = None
    frame_count = None
    notes: list[str] = []  # noqa: RUF012

    def __init__(self, fails_at: int = 10**9) -> None:
        self.closed = threading.Event()
        self.delivered = 0
        self._fails_at = fails_at

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        index = 0
        while not self.closed.wait(0.01):
            if index == self._fails_at:
                raise InputError("the lens fell off")
            now = time.monotonic_ns()
            image = np.zeros((4, 4, 3), np.uint8)
            yield Frame(index, now, now, image, guess_camera(4, 4))
            index += 1
            self.delivered = index

    def close(self) -> None:
        self.closed.set()


class CameraWithImu(LiveCamera):
    def samples(self) -> Iterator[TelemetrySample]:
        while not self.closed.wait(0.01):
            yield Depth(1, time.monotonic_ns(), "imu", 1.0)


def session_of(out: Path) -> RecordingSession:
    return RecordingSession(Recorder(out, RecordingConfig(picture="raw", reserve_mb=0)))


def hours_pass_when(so_far: Callable[[], bool], monkeypatch: pytest.MonkeyPatch) -> None:
    """The session's clock stands still until ``so_far``, and is then hours later."""
    began_s = time.monotonic()

    class SimulatedTime:
        monotonic_ns = time.monotonic_ns

        @staticmethod
        def monotonic() -> float:
            return began_s + 2.0 * HOUR_S * so_far()

    monkeypatch.setattr(session_module, "time", SimulatedTime)


def test_live_sources_are_recorded_until_time_is_up_and_then_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = {"front": LiveCamera(), "down": CameraWithImu()}
    session = session_of(tmp_path)
    session.add_live(cameras, [])

    def all_recorded() -> bool:
        return session.recorder.status.samples > 1 and all(c.delivered for c in cameras.values())

    hours_pass_when(all_recorded, monkeypatch)
    session.run(seconds=HOUR_S)
    assert all(camera.closed.is_set() for camera in cameras.values())
    assert session.recorder.status.samples > 1  # one is of the computer's clock
    for name in cameras:
        assert list(McapCamera(tmp_path, camera=name).frames())


def test_live_links_are_recorded_with_their_bytes(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    link = {"kind": "udp", "host": "127.0.0.1", "port": port}
    device = {"kind": "nmea0183", "link": link}
    config = TelemetryConfig.model_validate({"devices": {"compass": device}})
    session = session_of(tmp_path)
    session.add_live({}, [open_links(config, session.recorder.raw)])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as talker:

        def talk() -> None:
            deadline = time.monotonic() + GIVE_UP_S
            while session.recorder.status.samples < 4 and time.monotonic() < deadline:
                talker.sendto(f"{sentence(10.0)}\r\n".encode(), ("127.0.0.1", port))
                time.sleep(0.02)
            session.stopping.set()

        thread = threading.Thread(target=talk)
        thread.start()
        session.run()
        thread.join()
    telemetry = McapTelemetry(tmp_path)
    heard = [s.source for s in telemetry.samples() if not isinstance(s, UtcTime)]
    assert len(heard) >= 3
    again = list(telemetry.decoded_again(config.devices))
    assert [s.source for s in again[:3]] == heard[:3]
    clock = [s for s in telemetry.samples() if isinstance(s, UtcTime)]
    assert [utc.source for utc in clock] == ["computer/clock"]
    now_ns = time.time_ns() - time.monotonic_ns() + telemetry.origin_ns
    assert clock[0].utc_ns - clock[0].t_ns == pytest.approx(now_ns, abs=10**9)


def test_a_camera_that_fails_does_not_end_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, good_one = session_of(tmp_path), LiveCamera()
    session.add_live({"bad": LiveCamera(fails_at=3), "good": good_one}, [])
    at_failure: list[int] = []

    def more_came() -> bool:
        if session.notes and not at_failure:
            at_failure.append(good_one.delivered)
        return bool(at_failure) and good_one.delivered > at_failure[0] + 3

    hours_pass_when(more_came, monkeypatch)
    session.run(seconds=HOUR_S)
    assert session.notes == ["camera 'bad' failed: the lens fell off"]
    good = len(list(McapCamera(tmp_path, camera="good").frames()))
    assert good > len(list(McapCamera(tmp_path, camera="bad").frames())) == 3
