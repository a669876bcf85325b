"""Streams that die, are held back and come again: pictures of the past are not those of now."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable

import numpy as np
import pytest

from aquaflow.drivers.live import CameraState, LiveCamera
from aquaflow.sim_drivers.camera_feed import CameraFaults, CameraFeed, Shot
from aquaflow.sim_drivers.rtp_camera import RtspCamera
from aquaflow.types import Frame
from tests.drivers.camera_scenes import COUNT, Pictures, closing, settled, stream

FPS = 25.0
MAX_AGE_S = 0.5
SLOW_S = 0.4
"""By so much a busy machine may be slow at everything."""


class Remembered(CameraFeed):
    """Remembers when each picture was filmed."""

    def __init__(self, faults: CameraFaults | None = None) -> None:
        super().__init__(Pictures(), FPS, faults)
        self.filmed_ns: dict[int, list[int]] = {}

    def take(self) -> Shot:
        shot = super().take()
        self.filmed_ns.setdefault(shot.sequence % COUNT, []).append(shot.true_ns)
        return shot

    def age_s(self, frame: Frame) -> float:
        """How old it truly was when it arrived: the recording tells which of its pictures it is."""
        number = round(float(frame.image[:, 0].mean()) / 5.0)
        last_ns = max(t_ns for t_ns in self.filmed_ns[number] if t_ns <= frame.arrival_ns)
        return (frame.arrival_ns - last_ns) * 1e-9


class Viewer:
    """Takes every frame, in a thread of its own."""

    def __init__(self, camera: LiveCamera, shots: Remembered) -> None:
        self.camera, self.ages_s = camera, [0.0]
        self._shots = shots
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        for frame in self.camera.frames():
            if isinstance(frame, Frame):
                self.ages_s.append(self._shots.age_s(frame))

    def until(self, true: Callable[[], bool]) -> None:
        while not true():
            assert not self.camera._closing.wait(0.005), f"gave up: {self.camera.reason}"

    def shows(self, count: int) -> None:
        """Wait for so many more frames."""
        enough = len(self.ages_s) + count
        self.until(lambda: len(self.ages_s) >= enough)


def test_a_stream_that_died_shows_nothing_of_what_ffmpeg_still_holds() -> None:
    shots = Remembered()
    limits = {"stall_s": 1.0, "max_age_s": MAX_AGE_S}
    with RtspCamera(shots) as server, closing(stream(server.url, **limits)) as camera:
        viewer = Viewer(camera, shots)
        viewer.shows(20)
        server.sending.clear()
        viewer.until(lambda: camera.state in {CameraState.LOST, CameraState.CONNECTING})
        stale = camera.counters.stale
        server.sending.set()
        viewer.shows(20)
    assert settled(camera)
    assert stale > 4, "FFmpeg held nothing back"
    assert camera.counters.reconnects == 1
    assert max(viewer.ages_s) < MAX_AGE_S + SLOW_S


def test_what_a_link_held_back_is_left_out_until_it_is_of_now_again() -> None:
    """RTSP by TCP, blocked for a while: nothing is lost, and all comes late."""
    held_s = 1.5
    shots = Remembered(CameraFaults(delay_s={60: held_s}))
    with (
        RtspCamera(shots) as server,
        closing(stream(server.url, max_age_s=MAX_AGE_S)) as camera,
    ):
        viewer = Viewer(camera, shots)
        viewer.until(lambda: camera.state is CameraState.STREAMING)
        viewer.until(lambda: camera.state is CameraState.LATE)
        reason = camera.reason
        viewer.until(lambda: camera.state is CameraState.STREAMING)
        viewer.shows(10)
    assert settled(camera)
    assert reason.startswith("its pictures are ")
    assert camera.counters.stale > 0.6 * FPS * (held_s - MAX_AGE_S)
    assert camera.counters.reconnects == 0
    assert max(viewer.ages_s) < MAX_AGE_S + SLOW_S


def test_a_stream_that_stays_late_is_opened_anew(caplog: pytest.LogCaptureFixture) -> None:
    """A link that delays from one moment on, such as a relay whose buffer filled up."""
    shots = Remembered(CameraFaults(delay_s=dict.fromkeys(range(60, 10_000), 1.0)))
    limits = {"stall_s": 1.4, "max_age_s": MAX_AGE_S}
    with RtspCamera(shots) as server, closing(stream(server.url, **limits)) as camera:
        viewer = Viewer(camera, shots)
        viewer.until(lambda: camera.counters.reconnects == 1)
    assert re.search(r"is lost: its pictures are 1\.\d s old for 1.4 s", caplog.text)


def test_without_a_limit_pictures_are_stamped_when_they_arrive() -> None:
    with (
        RtspCamera(Remembered()) as server,
        closing(stream(server.url, max_age_s=None, latency_s=0.1)) as camera,
    ):
        frames = camera.frames()
        seen = [next(frames) for _ in range(3)]
    assert all(isinstance(frame, Frame) for frame in seen)
    delays = [frame.arrival_ns - frame.t_ns for frame in seen if isinstance(frame, Frame)]
    assert np.all(np.array(delays) == 100_000_000)
    assert camera.counters.stale == 0
