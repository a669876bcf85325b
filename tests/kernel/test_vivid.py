"""The V4L2 driver on a real kernel: its virtual camera vivid, unplugged and plugged in again."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.live import CameraState
from aquaflow.drivers.v4l2 import V4l2Camera
from aquaflow.drivers.v4l2.discovery import camera_nodes, modes
from aquaflow.drivers.v4l2.system import Kernel
from aquaflow.types import Frame
from tests.kernel.virtual_machine import in_guest

BUS, PLANAR_BUS = "platform:vivid-000", "platform:vivid-001"
"""Of the camera with pictures in one piece of memory, and of the one with the multi-planar API."""
DRIVER = Path("/sys/bus/platform/drivers/vivid")
SIZE = (320, 180)

GIVE_UP_S = 120.0


def control(setting: str) -> None:
    """Misbehave, or behave again."""
    subprocess.run(["v4l2-ctl", "-d", "/dev/video0", "-c", setting], check=True, timeout=30)


@contextmanager
def vivid(**settings: object) -> Iterator[V4l2Camera]:
    asked = {"width": SIZE[0], "height": SIZE[1], "fps": 10, "pixels": "YUYV"}
    config = V4l2Config.model_validate(
        {"kind": "v4l2", "device": BUS, "first_retry_s": 0.1, **asked, **settings}
    )
    camera = V4l2Camera("vivid", config)
    alarm = threading.Timer(GIVE_UP_S, camera.close)
    alarm.start()
    try:
        yield camera
    finally:
        alarm.cancel()
        camera.close()


def received(camera: V4l2Camera, count: int) -> list[Frame]:
    frames = []
    for frame in camera.frames():
        assert isinstance(frame, Frame)
        frames.append(frame)
        if camera.counters.received >= count:
            break
    assert camera.counters.received >= count, f"gave up: {camera.reason}"
    return frames


def settled(camera: V4l2Camera) -> bool:
    n = camera.counters
    return n.received == n.delivered + n.overtaken + n.duplicates + n.unusable + n.passed_over


@in_guest
def test_of_vivids_many_nodes_only_one_is_a_camera() -> None:
    assert len(list(Path("/dev").glob("video*"))) > 2
    for node, bus in zip(camera_nodes(Kernel()), (BUS, PLANAR_BUS), strict=True):
        assert node.name == "vivid"
        assert node.ids == (bus,)
        assert "YUYV up to 3840 x 2160" in modes(Kernel(), node.path)


@in_guest
def test_pictures_come_in_order_with_the_kernels_times() -> None:
    with vivid() as camera:
        frames = received(camera, 20)
    assert settled(camera)
    assert camera.notes == []
    assert np.all(np.diff([frame.index for frame in frames]) > 0)
    assert np.all(np.diff([frame.t_ns for frame in frames]) > 0)
    assert (camera.counters.unusable, camera.counters.duplicates) == (0, 0)
    for frame in frames:
        assert frame.image.shape == (SIZE[1], SIZE[0], 3)
        assert np.ptp(frame.image) > 100  # colour bars


@in_guest
def test_a_format_that_it_has_not_is_told_and_replaced() -> None:
    with vivid(pixels="MJPG", width=300) as camera:
        (frame, *_) = received(camera, 3)
    assert frame.image.shape == (SIZE[1], SIZE[0], 3)
    assert "the camera gives 320 x 180" in camera.notes[0]


@in_guest
def test_every_arrangement_of_pixels_shows_the_same_picture() -> None:
    """Colour bars, in one piece of memory, in one by the multi-planar API, and in two."""
    shown = {}
    for bus, pixels in [
        *((BUS, each) for each in ("YUYV", "UYVY", "NV12")),
        *((PLANAR_BUS, each) for each in ("YUYV", "NV12", "NM12")),
    ]:
        with vivid(device=bus, pixels=pixels) as camera:
            frame = received(camera, 3)[-1]
            assert camera.notes == [], (bus, pixels)
        # Below the text, the bars stand still.
        shown[bus, pixels] = frame.image[SIZE[1] // 2 :].astype(int)
    first = shown[BUS, "YUYV"]
    assert np.ptp(first) > 100
    for which, image in shown.items():
        # Where two bars meet, pixels share their colours differently.
        assert np.median(np.abs(image - first)) <= 2, which
        assert np.mean(np.abs(image - first) > 8) < 0.1, which


@in_guest
def test_gain_is_fixed_and_exposure_which_it_has_not_is_told() -> None:
    with vivid(gain=50, exposure_s=0.01) as camera:
        (frame, *_) = received(camera, 3)
    assert (frame.gain, frame.exposure_s) == (50.0, None)
    assert camera.notes == ["the camera has no fixed exposure; it decides for itself"]


@in_guest
def test_a_camera_in_use_is_told() -> None:
    with vivid() as camera, vivid() as second:
        received(camera, 3)
        with pytest.raises(InputError, match="/dev/video0: another program has it"):
            second.connect()


@in_guest
def test_dropped_buffers_are_counted_by_sequence() -> None:
    with vivid() as camera:
        received(camera, 5)
        control("percentage_of_dropped_buffers=40")
        try:
            frames = received(camera, 35)
        finally:
            control("percentage_of_dropped_buffers=0")
    assert settled(camera)
    assert camera.counters.lost > 3
    missing = camera.counters.lost + camera.counters.overtaken
    assert missing >= frames[-1].index - frames[0].index + 1 - len(frames)


@in_guest
def test_it_comes_back_after_it_was_unplugged() -> None:
    with vivid() as camera:
        before = received(camera, 10)
        control("disconnect=1")
        while camera.state is not CameraState.LOST:
            assert not camera._closing.wait(0.05), "gave up"
        (DRIVER / "unbind").write_text("vivid.0")
        assert camera_nodes(Kernel()) == []
        (DRIVER / "bind").write_text("vivid.0")
        after = received(camera, camera.counters.received + 10)
    assert settled(camera)
    assert camera.counters.reconnects == 1
    assert after[0].index > before[-1].index
    assert after[0].t_ns > before[-1].t_ns
