"""Devices behind the feed: the newest picture, unplugged and back; links that are flooded."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.config import SourceConfig
from aquaflow.config.cameras import V4l2Config
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.drivers.transport import opener
from aquaflow.drivers.v4l2 import V4l2Camera
from aquaflow.geometry.camera import guess_camera
from aquaflow.live.clock_reading import Continued
from aquaflow.live.feed import LiveFeed, PlaybackFeed
from aquaflow.live.health.exposition import device_lines
from aquaflow.recordings.playback import Playback
from aquaflow.sim_drivers.camera_feed import CameraFaults, CameraFeed
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.wires import UdpWire
from aquaflow.sim_drivers.faults import Faults, faulty
from aquaflow.sim_drivers.v4l2_kernel import V4l2Kernel
from aquaflow.types import CameraModel, Depth, Dropped, Frame, TelemetrySample, UtcTime
from tests.live.live_scenes import HEIGHT, WIDTH
from tests.small_recording import GIVE_UP_S

QUICK = {"stall_s": 60.0, "first_retry_s": 0.02, "last_retry_s": 0.05}


class Pictures:
    """A recording of plain pictures."""

    camera: CameraModel | None = None
    frame_count: int | None = 40

    def __init__(self) -> None:
        self.notes: list[str] = []

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        for index in range(start, 40, every):
            image = np.full((HEIGHT, WIDTH, 3), 5 * index, np.uint8)
            yield Frame(index, index, index, image, guess_camera(WIDTH, HEIGHT))

    def close(self) -> None: ...


def camera(root: Path, faults: CameraFaults) -> V4l2Camera:
    kernel = V4l2Kernel(root, CameraFeed(Pictures(), 100.0, faults), None)
    asked = {"kind": "v4l2", "pixels": "YUYV", "width": WIDTH, "height": HEIGHT, **QUICK}
    return V4l2Camera("front", V4l2Config.model_validate(asked), kernel, root)


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + GIVE_UP_S
    while not true():
        assert time.monotonic() < deadline, "gave up"
        time.sleep(0.01)


def test_an_unplugged_camera_tells_why_and_its_pictures_come_again(tmp_path: Path) -> None:
    front = camera(tmp_path, CameraFaults(disconnect=frozenset({5}), away_s=0.3))
    feed = LiveFeed("front", {"front": front}, None, SourceConfig())
    feed.start()
    try:
        until(lambda: feed.newest.take(0.1) is not None and front.counters.reconnects == 1)
        (device,) = feed.describe().values()
        assert (device["kind"], device["state"]) == ("camera", "streaming")
        assert device["reconnects"] == 1
        told = "".join(f"{line}\n" for line in device_lines(feed.describe()))
        assert 'aquaflow_device_up{device="front",kind="camera"} 1\n' in told
        assert 'aquaflow_device_reconnects_total{device="front"} 1\n' in told
        assert 'aquaflow_device_age_seconds{device="front"} 0.' in told
    finally:
        feed.close()


def test_the_computers_clock_is_heard_as_a_recording_holds_it(tmp_path: Path) -> None:
    feed = LiveFeed("front", {"front": camera(tmp_path, CameraFaults())}, None, SourceConfig())
    feed.start()
    try:
        until(lambda: feed.latest_samples.samples > 0)
        ((utc, _),) = feed.latest_samples.latest()
        assert (type(utc), utc.source) == (UtcTime, "computer/clock")
    finally:
        feed.close()
    assert not any(thread.name == "wall clock" for thread in threading.enumerate())


def test_a_new_dive_counts_from_its_first_frame_with_the_samples_before_it(tmp_path: Path) -> None:
    front = camera(tmp_path, CameraFaults())
    early = Depth(7, 8, "bar30", 1.0)
    feed = LiveFeed("front", {"front": front}, None, SourceConfig())
    feed.continue_from(Continued())
    feed.latest_samples.take(early)
    assert feed.latest_samples.take_new() == []  # nothing says yet where the dive begins
    feed.start()
    try:
        frames: list[Frame | Dropped] = []
        until(lambda: (frame := feed.take(1.0)) is not None and frames.append(frame) is None)
        shift_ns = feed.continued.shift_ns
        assert shift_ns is not None
        assert frames[0].t_ns == 0
        sample = feed.latest_samples.take_new()[0]
        assert (sample.t_ns, sample.arrival_ns) == (7 + shift_ns, 8 + shift_ns)
    finally:
        feed.close()


def test_only_pictures_that_are_asked_for_are_decoded(tmp_path: Path) -> None:
    front = camera(tmp_path, CameraFaults())
    feed = LiveFeed("front", {"front": front}, None, SourceConfig())
    feed.start()
    try:
        taken: list[Frame | Dropped] = []
        until(lambda: (frame := feed.take(1.0)) is None or taken.append(frame) is None)
        until(lambda: front.counters.received > 20)
        assert front.counters.delivered <= len(taken) + 2
        assert feed.newest.overtaken == 0  # what is left out, the camera's own queue leaves out
    finally:
        feed.close()


def test_a_resumed_dive_counts_a_devices_pictures_on(tmp_path: Path) -> None:
    feed = LiveFeed("front", {"front": camera(tmp_path, CameraFaults())}, None, SourceConfig())
    feed.continue_from(Continued(first_index=1000, shift_ns=10**15))
    feed.start()
    try:
        frame = feed.take(GIVE_UP_S)
        assert frame is not None
        assert 1000 <= frame.index < 1100
        assert frame.t_ns > 10**15
    finally:
        feed.close()


class Telemetry:
    """A depth with every picture."""

    def samples(self) -> Iterator[TelemetrySample]:
        for index in range(40):
            yield Depth(index, index, "truth", float(index))

    def close(self) -> None: ...


def test_a_resumed_recording_goes_on_at_once_behind_what_was_seen() -> None:
    slept: list[float] = []
    playback = Playback(Pictures(), [Telemetry()], 1e-9, lambda: 0, slept.append)
    feed = PlaybackFeed(playback, SourceConfig(every=3), None, str, [])
    feed.continue_from(Continued(first_index=35))
    feed.start()
    until(lambda: not any(thread.name == "recording" for thread in threading.enumerate()))
    feed.close()
    assert feed.failure is None
    assert feed.latest_samples.samples == 4  # those of the pictures 36 to 39
    assert slept == pytest.approx([1.0, 2.0, 3.0, 3.0])  # samples 37, 38, picture and sample 39


def test_a_camera_whose_driver_fails_ends_the_feed_with_a_reason(tmp_path: Path) -> None:
    front = camera(tmp_path, CameraFaults())
    front.frames = lambda every=1: iter(_failing())  # type: ignore[method-assign,assignment]
    feed = LiveFeed("front", {"front": front}, None, SourceConfig())
    feed.start()
    feed.newest.take(GIVE_UP_S)
    until(lambda: feed.newest.ended)
    feed.close()
    assert feed.failure is not None
    assert "told so" in feed.failure


def _failing() -> Iterator[Frame]:
    raise ValueError("told so")
    yield


def test_the_clocks_of_the_devices_are_told_and_taken_up_again() -> None:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    known = {"autopilot": [(12, 12 * 10**9, 345, None, None)]}
    told = {**known, "sonar": [(1, 2, 3, None, None)]}  # one device is no longer there
    link = {"kind": "udp", "mode": "listen", "host": "127.0.0.1", "port": UdpWire().port}
    config = parse_telemetry({"devices": {"autopilot": {"kind": "mavlink", "link": link}}}, "test")
    feed = LiveFeed("none", {}, LinkTelemetry(config), SourceConfig())
    try:
        assert feed.clocks() == {"autopilot": []}
        feed.continue_from(Continued(clocks=told))
        decoder = feed._telemetry.decoders["autopilot"]  # type: ignore[union-attr]
        decoder.clock.mapping.add(13 * 10**9, 13 * 10**9 + 400)
        assert feed.clocks()["autopilot"][:1] == known["autopilot"]
    finally:
        feed.close()


def test_a_flood_of_garbage_costs_its_bytes_and_no_sample() -> None:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    wire = UdpWire()
    link = {"kind": "udp", "mode": "send", "host": "127.0.0.1", "port": wire.port}
    config = parse_telemetry({"devices": {"autopilot": {"kind": "mavlink", "link": link}}}, "test")
    flooded, injected = faulty(
        opener("autopilot", config.devices["autopilot"].link), Faults(flood=0.5)
    )
    telemetry = LinkTelemetry(config, links={"autopilot": flooded})
    samples = [Depth(i * 20_000_000, i * 20_000_000, "truth", 3.0) for i in range(400)]
    device = SimulatedDevice(ArduSub(), wire, samples).start()
    feed = LiveFeed("none", {}, telemetry, SourceConfig())
    feed.start()
    try:
        until(lambda: injected["flood"] > 3 and feed.latest_samples.samples > 10)
        (described,) = feed.describe().values()
        assert described["state"] == "connected"
        assert described["age_s"] is not None
        assert int(str(described["garbage_bytes"])) > 100_000
        assert all(
            abs(s.depth_m - 3.0) < 0.1
            for s, _ in feed.latest_samples.latest()
            if isinstance(s, Depth)
        )
    finally:
        device.close()
        feed.close()


class FailsOnce(Pictures):
    """A recording that cannot be read once, at picture 5."""

    failed = False

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        for frame in super().frames(every, start, stop):
            if frame.index == 5 and not self.failed:
                self.failed = True
                raise OSError(errno.EIO, "Input/output error")
            yield frame


class FailsAtTheEnd(Pictures):
    """A recording that fails when it is closed after its last picture."""

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        yield from super().frames(every, start, stop)
        raise OSError(errno.EIO, "Input/output error")


@pytest.mark.parametrize(("recording", "dropped"), [(FailsOnce, [5]), (FailsAtTheEnd, [])])
def test_a_picture_that_cannot_be_read_costs_itself(
    recording: type[Pictures], dropped: list[int]
) -> None:
    failures, taken = Failures(strict=False), list[Frame | Dropped]()
    playback = Playback(recording(), [], failures=failures)
    feed = PlaybackFeed(playback, SourceConfig(), None, str, [], failures)
    feed.newest.put = taken.append  # type: ignore[method-assign]
    feed.start()
    until(lambda: feed.newest.ended)
    feed.close()
    assert [frame.index for frame in taken] == list(range(40))
    assert [frame.index for frame in taken if isinstance(frame, Dropped)] == dropped
    assert feed.failure is None
    assert failures.total == 1
