"""A live run whose stream dies: the pilot hears of it once, and of its return once."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from aquaflow.config import SourceConfig
from aquaflow.config.cameras import StreamConfig
from aquaflow.config.service import ServiceConfig
from aquaflow.drivers.live import CameraState
from aquaflow.drivers.stream import StreamCamera
from aquaflow.live.control import ServiceControl
from aquaflow.live.feed import LiveFeed
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.state import ServiceState
from aquaflow.live.loop import PATIENCE_S, LiveLoop
from aquaflow.sim_drivers.camera_feed import CameraFeed
from aquaflow.sim_drivers.rtp_camera import RtpCamera, RtspCamera
from tests.drivers.camera_scenes import Pictures, free_port
from tests.live.live_scenes import Told
from tests.small_recording import GIVE_UP_S

STALL_S = PATIENCE_S + 1.0
"""FFmpeg gives out what it held back of RTSP when this has passed, after the run began to wait."""


def until(true: Callable[[], bool], loop: LiveLoop) -> None:
    deadline = time.monotonic() + GIVE_UP_S
    while not true():
        assert time.monotonic() < deadline, f"gave up: {loop.health.state}, {loop.health.reason}"
        time.sleep(0.02)


@pytest.mark.parametrize("kind", ["rtp", "rtsp"])
def test_a_dead_stream_is_waited_for_and_comes_back_without_flapping(
    kind: str, tmp_path: Path
) -> None:
    shots, port = CameraFeed(Pictures(), 20.0), free_port()
    server = RtpCamera(port, shots) if kind == "rtp" else RtspCamera(shots)
    url = server.url if isinstance(server, RtspCamera) else f"udp://0.0.0.0:{port}"
    asked = {"kind": "stream", "url": url, "stall_s": STALL_S}
    camera = StreamCamera("front", StreamConfig.model_validate(asked))
    feed = LiveFeed("front", {"front": camera}, None, SourceConfig())
    told = Told(tmp_path)
    control, vitals = ServiceControl(), ServiceHealth(ServiceConfig())
    loop = LiveLoop(
        told.run, feed, told.maps, ServiceConfig(), vitals, control, lambda: told.pressure
    )
    thread = threading.Thread(target=loop.run, daemon=True)
    with server:
        thread.start()
        until(lambda: loop.health.state is ServiceState.TRACKING, loop)
        server.sending.clear()
        until(lambda: camera.state is not CameraState.STREAMING, loop)
        assert loop.health.state is ServiceState.WAITING
        assert "no picture for" in loop.health.reason
        server.sending.set()
        until(lambda: loop.health.state is ServiceState.TRACKING, loop)
        control.stopping.set()
        thread.join()
        feed.close()
    vitals.close()
    told.close()
    states = [change.after for change in loop.health.changes]
    assert states == [ServiceState.TRACKING, ServiceState.WAITING, ServiceState.TRACKING]
