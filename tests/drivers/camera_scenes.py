"""Live cameras of every kind in front of the same small recording, for the tests of all of them."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from aquaflow.config.cameras import OakConfig, StreamConfig, V4l2Config
from aquaflow.drivers.live import LiveCamera
from aquaflow.drivers.oak import OakCamera
from aquaflow.drivers.stream import StreamCamera
from aquaflow.drivers.v4l2 import V4l2Camera
from aquaflow.geometry.camera import guess_camera
from aquaflow.sim_drivers.camera_feed import CameraFaults, CameraFeed
from aquaflow.sim_drivers.mjpeg_server import MjpegServer
from aquaflow.sim_drivers.oak import ReplayOak
from aquaflow.sim_drivers.rtp_camera import RtpCamera
from aquaflow.sim_drivers.v4l2_kernel import CameraSpec, V4l2Kernel
from aquaflow.types import CameraModel, Dropped, Frame
from tests.small_recording import GIVE_UP_S

WIDTH, HEIGHT, COUNT = 64, 48, 40

QUICK = {"stall_s": 60.0, "first_retry_s": 0.02, "last_retry_s": 0.05}
"""A machine that is slow has no silent camera: what is silent says so by its own ``stall_s``."""

KINDS = ("v4l2-YUYV", "v4l2-MJPG", "v4l2-GREY", "oak", "stream", "rtp")


class Pictures:
    """A recording of smooth pictures, each of another brightness."""

    camera: CameraModel | None = None
    frame_count: int | None = COUNT

    def __init__(self) -> None:
        self.notes: list[str] = []

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        ramp = np.linspace(0.0, 40.0, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 3))
        for index in range(COUNT):
            image = (ramp + 5 * index).astype(np.uint8)
            yield Frame(index, index, index, image, guess_camera(WIDTH, HEIGHT))

    def close(self) -> None: ...


def feed(faults: CameraFaults | None = None, fps: float = 100.0) -> CameraFeed:
    return CameraFeed(Pictures(), fps, faults)


def v4l2(
    shots: CameraFeed,
    root: Path,
    pixels: str = "YUYV",
    spec: CameraSpec | None = None,
    **more: object,
) -> tuple[V4l2Camera, V4l2Kernel]:
    kernel = V4l2Kernel(root, shots, spec)
    size = {"width": WIDTH, "height": HEIGHT}
    config = V4l2Config.model_validate({"kind": "v4l2", "pixels": pixels, **size, **QUICK, **more})
    return V4l2Camera("front", config, kernel, root), kernel


def oak(shots: CameraFeed, **more: object) -> tuple[OakCamera, ReplayOak]:
    device = ReplayOak(shots)
    config = OakConfig.model_validate({"kind": "oak", **QUICK, **more})
    return OakCamera("front", config, device.open), device


def stream(url: str, **more: object) -> StreamCamera:
    config = StreamConfig.model_validate({"kind": "stream", "url": url, **QUICK, **more})
    return StreamCamera("front", config)


def free_port() -> int:
    """An even UDP port that is free, and the next one, which RTP needs as well, too."""
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
            first.bind(("127.0.0.1", 0))
            port = int(first.getsockname()[1])
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
                try:
                    second.bind(("127.0.0.1", port + 1))
                except OSError:
                    continue
            if port % 2 == 0:
                return port


@contextmanager
def live(kind: str, faults: CameraFaults, root: Path, fps: float = 100.0) -> Iterator[LiveCamera]:
    """A camera of any kind in front of the same feed."""
    shots = feed(faults, fps)
    if kind == "stream":
        with MjpegServer(shots) as server, closing(stream(server.url)) as camera:
            yield camera
    elif kind == "rtp":
        port = free_port()
        with RtpCamera(port, shots), closing(stream(f"udp://127.0.0.1:{port}")) as camera:
            yield camera
    elif kind == "oak":
        with closing(oak(shots)[0]) as camera:
            yield camera
    else:
        with closing(v4l2(shots, root, kind.removeprefix("v4l2-"))[0]) as camera:
            yield camera


@contextmanager
def closing(camera: LiveCamera) -> Iterator[LiveCamera]:
    """Close it, also when a test would wait for ever."""
    alarm = threading.Timer(GIVE_UP_S, camera.close)
    alarm.daemon = True
    alarm.start()
    try:
        yield camera
    finally:
        alarm.cancel()
        camera.close()


def until(
    camera: LiveCamera,
    received: int,
    enough: Callable[[Frame | Dropped], bool] = lambda newest: True,
) -> list[Frame | Dropped]:
    """What came until the device had handed over ``received`` pictures and the newest is
    ``enough``, and nothing else will."""
    seen = []
    for frame in camera.frames():
        seen.append(frame)
        if camera.counters.received >= received and enough(frame):
            break
    assert camera.counters.received >= received, f"gave up: {camera.state}, {camera.reason}"
    camera.close()
    return seen


def settled(camera: LiveCamera) -> bool:
    """Every picture that was received ended in exactly one counter."""
    n = camera.counters
    ends = n.delivered + n.overtaken + n.passed_over + n.stale + n.unusable + n.duplicates
    return n.received == ends
