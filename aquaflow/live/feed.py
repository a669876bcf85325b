"""Sources of frames and telemetry: each is read in its own thread, never waiting for mapping.

Two queues between a camera and tracking keep only the newest item, and both are needed. The queue
of the camera (drivers/live.py) holds a raw picture, in a buffer of the device, until it is decoded.
The queue in this module holds a frame until tracking takes it. Only one of them drops frames:
without a recorder a picture is decoded when tracking waits for one, so that this queue drops none;
with a recorder every picture is decoded and recorded in the reading thread, and this queue keeps
the newest of them.

With only the camera's queue, recording would be as slow as tracking, and the loop, whose heartbeat
needs a timeout, would wait inside a driver's iterator, which has none. With only this queue, unused
pictures would be decoded, or would occupy the device's buffers. Playback of a recording has only
this queue.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Protocol, runtime_checkable

from aquaflow.base.clocks.device import Learned
from aquaflow.base.errors.failures import Failures
from aquaflow.config import Config, SourceConfig
from aquaflow.config.service import ServiceConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live.clock_reading import Continued, WallClock
from aquaflow.live.recorder.recorder import Recorder
from aquaflow.live.recorder.session import HasSamples
from aquaflow.recordings.playback import Event, Playback, delay_event, read_past_failures
from aquaflow.sources import CameraSource, TelemetrySource, mounting_of
from aquaflow.sources.newest import Newest
from aquaflow.sources.outbound import AcceptsMessages, HearsPilot, OutboundMessage
from aquaflow.types import CameraModel, Dropped, Frame, TelemetrySample

log = logging.getLogger(__name__)

ASK_S = 0.5
"""How often a waiting pump thread checks whether it shall end."""
MOST_SAMPLES = 100_000
"""Samples that wait for the loop: ten minutes at 160 a second; it takes them with every frame."""
JOIN_S = 3.0
"""Longest wait for a pump; one that hangs in a device's library ends with the process."""


class LatestSamples:
    """The newest sample of every telemetry source; written by pumps, read by anyone."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self.samples = 0
        self.shift_ns: int | None = 0
        """From the sources' clock to the dive's; None keeps the samples waiting."""
        self._now_s = now_s
        self._latest: dict[tuple[str, str], tuple[TelemetrySample, float]] = {}
        self._new: deque[TelemetrySample] = deque(maxlen=MOST_SAMPLES)

    def take(self, sample: TelemetrySample) -> None:
        """Count the sample and keep it as the latest of its source and kind."""
        self.samples += 1
        self._latest[sample.source, type(sample).__name__] = sample, self._now_s()
        self._new.append(sample)

    def take_new(self) -> list[TelemetrySample]:
        """Those that came since the last call, in the order of arrival, on the dive's clock."""
        shift_ns = self.shift_ns
        if shift_ns is None:
            return []
        return [_later(self._new.popleft(), shift_ns) for _ in range(len(self._new))]

    def forget(self) -> None:
        """Drop those that wait: no dive wants them."""
        self._new.clear()

    def latest(self) -> list[tuple[TelemetrySample, float]]:
        """The newest of each source and kind, and the seconds since it came."""
        now = self._now_s()
        return [(sample, now - came) for sample, came in list(self._latest.values())]


def _later(sample: TelemetrySample, by_ns: int) -> TelemetrySample:
    if by_ns == 0:
        return sample
    return replace(sample, t_ns=sample.t_ns + by_ns, arrival_ns=sample.arrival_ns + by_ns)


@runtime_checkable
class HasDeviceClocks(Protocol):
    """A telemetry source whose devices have clocks of their own."""

    def learned_mappings(self) -> Mapping[str, Learned]:
        """The clock mappings learned so far, by device."""
        ...

    def resume(self, learned: Mapping[str, Learned]) -> None:
        """Continue with what an earlier process had learned."""
        ...


class Feed(Protocol):
    """The newest frame of one camera, and telemetry."""

    newest: Newest[Frame | Dropped]
    latest_samples: LatestSamples
    notes: list[str]
    failure: str | None
    """Why the camera stopped, unless its recording ended."""
    failures: Failures
    """Errors raised while reading; the dive adds its own."""
    continued: Continued
    """Where frame indices and time of an earlier run go on."""
    lasting: bool
    """True if pictures may come for ever: between dives the service waits for the pilot."""

    @property
    def calibration(self) -> CameraModel | None: ...

    @property
    def pilot(self) -> HearsPilot | None:
        """Tells of the pilot; None where nothing can."""
        ...

    def name_of(self, index: int) -> str:
        """Source name of a frame, for frames.csv."""
        ...

    def describe(self) -> dict[str, dict[str, object]]:
        """State and counters of each device, for health."""
        ...

    def continue_from(self, continued: Continued) -> None:
        """Continue frame indices and time of an earlier run; call it before ``start``."""
        ...

    def take(self, timeout_s: float) -> Frame | Dropped | None:
        """The newest frame, counted as the dive counts; None after ``timeout_s`` without one."""
        ...

    def forget(self) -> None:
        """A dive has ended: what failed, was noted, or waits is not the next one's."""
        ...

    def stated_mounting(self) -> MountingConfig | None:
        """Stated mounting of the mapping camera in the body; see
        :func:`aquaflow.sources.mounting_of`."""
        ...

    def dive_s(self) -> float | None:
        """Seconds since the dive's first frame; None before it, and in a recording."""
        ...

    def clocks(self) -> Mapping[str, Learned]:
        """The learned clock mappings by device, for a run that continues this one."""
        ...

    def send(self, message: OutboundMessage) -> bool:
        """Send ``message`` to the vehicle; False if no device there understands it."""
        ...

    def start(self) -> None:
        """Begin to read the sources, in threads; once, however often it is called."""
        ...

    def close(self) -> None: ...


class _Pumps:
    """Threads that end when the feed is closed."""

    def __init__(self, failures: Failures | None = None) -> None:
        self.failures = failures or Failures()
        self.newest: Newest[Frame | Dropped] = Newest()
        self.latest_samples = LatestSamples()
        self.notes: list[str] = []
        self.failure: str | None = None
        self.continued = Continued()
        self.closing = threading.Event()
        self._threads: list[threading.Thread] = []

    def continue_from(self, continued: Continued) -> None:
        self.continued = continued

    def dive_s(self) -> float | None:
        return None

    def take(self, timeout_s: float) -> Frame | Dropped | None:
        return self.newest.take(timeout_s)

    def forget(self) -> None:
        self.failures, self.notes = Failures(), []
        self.latest_samples.forget()

    def clocks(self) -> Mapping[str, Learned]:
        return {}

    @property
    def pilot(self) -> HearsPilot | None:
        return None

    @property
    def started(self) -> bool:
        """True once the sources are being read."""
        return bool(self._threads)

    def pump(self, name: str, work: Callable[[], None], last: bool = False) -> None:
        """Run ``work``; with ``last``, no frame comes after its end."""

        def guard() -> None:
            try:
                work()
            except Exception as error:
                self.failures.record(name, error)
                self.failure = f"{name} failed: {error}" if last else self.failure
                self.notes.append(f"{name} failed: {error}")
            finally:
                if last:
                    self.newest.end()

        thread = threading.Thread(target=guard, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def join(self) -> None:
        self.closing.set()
        self.newest.end()
        for thread in self._threads:
            thread.join(JOIN_S)


class LiveFeed(_Pumps):
    """Devices. The camera's own queue keeps the newest picture, which is decoded when the loop
    waits for it; with a recorder every picture is decoded, and this queue keeps the newest."""

    lasting = True

    def __init__(
        self,
        name: str,
        cameras: Mapping[str, CameraSource],
        telemetry: TelemetrySource | None,
        source: SourceConfig,
        recorder: Recorder | None = None,
    ) -> None:
        """``name``: of the camera that maps; the others are recorded only."""
        super().__init__()
        self.name, self._cameras, self._telemetry = name, cameras, telemetry
        self._source, self._recorder = source, recorder
        self._clock = WallClock()

    @property
    def calibration(self) -> CameraModel | None:
        return self._cameras[self.name].camera

    @property
    def pilot(self) -> HearsPilot | None:
        return self._telemetry if isinstance(self._telemetry, HearsPilot) else None

    def name_of(self, index: int) -> str:
        return f"{self.name}#{index}"

    def stated_mounting(self) -> MountingConfig | None:
        return mounting_of(self._cameras[self.name])

    def describe(self) -> dict[str, dict[str, object]]:
        devices: dict[str, dict[str, object]] = {}
        for name, camera in self._cameras.items():
            devices[name] = {"kind": "camera", **_state_of(camera)}
        for name, link in getattr(self._telemetry, "links", {}).items():
            devices[name] = {"kind": "link", **_state_of(link)}
        if self._recorder is not None:
            stopped = self._recorder.status.stopped
            state = "recording" if stopped is None else "stopped"
            devices["recorder"] = {"kind": "recorder", "state": state, "reason": stopped or ""}
        return devices

    def continue_from(self, continued: Continued) -> None:
        super().continue_from(continued)
        self.latest_samples.shift_ns = continued.shift_ns
        if continued.clocks and isinstance(self._telemetry, HasDeviceClocks):
            self._telemetry.resume(continued.clocks)

    def dive_s(self) -> float | None:
        return self.continued.dive_s(time.monotonic_ns())

    def take(self, timeout_s: float) -> Frame | Dropped | None:
        """A new dive begins with the first frame that is taken."""
        frame = self.newest.take(timeout_s)
        if frame is None:
            return None
        self.continued = self.continued.begin(frame.t_ns)
        self.latest_samples.shift_ns = self.continued.shift_ns
        return self.continued.count(frame)

    def clocks(self) -> Mapping[str, Learned]:
        return (
            self._telemetry.learned_mappings()
            if isinstance(self._telemetry, HasDeviceClocks)
            else {}
        )

    def send(self, message: OutboundMessage) -> bool:
        return isinstance(self._telemetry, AcceptsMessages) and self._telemetry.send(message)

    def start(self) -> None:
        """Open cameras and telemetry, and read them in threads."""
        if self.started:
            return
        for name, camera in self._cameras.items():
            mapped = name == self.name
            if mapped or self._recorder is not None:
                self.pump(f"camera '{name}'", partial(self._frames, name, mapped), mapped)
            if isinstance(camera, HasSamples):
                self.pump(f"IMU of '{name}'", partial(self._samples, camera))
        if self._telemetry is not None:
            self.pump("telemetry", partial(self._samples, self._telemetry))
        self.pump("wall clock", partial(self._samples, self._clock))

    def close(self) -> None:
        self.closing.set()
        self._clock.close()
        for camera in self._cameras.values():
            camera.close()
        if self._telemetry is not None:
            self._telemetry.close()
        self.join()
        if self._recorder is not None:
            self._recorder.close()

    def _frames(self, name: str, mapped: bool) -> None:
        frames = self._cameras[name].frames(self._source.every if mapped else 1)
        for frame in self._when_asked(frames) if self._recorder is None else frames:
            if self._recorder is not None:
                self._recorder.frame(name, frame)
            if mapped:
                self.newest.put(frame)

    def _when_asked(self, frames: Iterator[Frame | Dropped]) -> Iterator[Frame | Dropped]:
        while not self.closing.is_set():
            if self.newest.wait_for_consumer(ASK_S):
                frame = next(frames, None)
                if frame is None:
                    return
                yield frame

    def _samples(self, source: HasSamples) -> None:
        for sample in source.samples():
            self.latest_samples.take(sample)
            if self._recorder is not None:
                self._recorder.sample(sample)


class PlaybackFeed(_Pumps):
    """A recording played back in real time: time differences are kept, arrivals are what they are
    here."""

    lasting = False

    def __init__(
        self,
        playback: Playback,
        source: SourceConfig,
        calibration: CameraModel | None,
        name_of: Callable[[int], str],
        notes: list[str],
        failures: Failures | None = None,
    ) -> None:
        """Continue with the first frame that an earlier run did not process."""
        super().__init__(failures)
        self.calibration, self.name_of, self._notes = calibration, name_of, notes
        self._playback, self._source = playback, source

    def stated_mounting(self) -> MountingConfig | None:
        return self._playback.stated_mounting()

    def describe(self) -> dict[str, dict[str, object]]:
        return {}

    def send(self, message: OutboundMessage) -> bool:
        return False

    def start(self) -> None:
        """Play the recording back in a thread."""
        if self.started:
            return
        self.pump("recording", self._events, last=True)

    def close(self) -> None:
        self.join()
        self._playback.close()

    def _events(self) -> None:
        source, start = self._source, self._source.start
        while start < self.continued.first_index:
            start += source.every
        count = self._playback.frame_count
        for event in read_past_failures(
            self._read, start, source, count, self.failures, self._give_up
        ):
            if self.closing.is_set():
                break
            # Moments stay as recorded, so that frames.csv can be compared with a replay's.
            now = delay_event(event, 0, time.monotonic_ns())
            if isinstance(now, (Frame, Dropped)):
                self.newest.put(now)
            else:
                self.latest_samples.take(now)
        self.notes += self._notes

    def _read(self, start: int) -> Iterator[Event]:
        return self._playback.events(self._source.every, start, self._source.stop)

    def _give_up(self, frame: int) -> None:
        self.notes.append(f"the recording could not be read after frame {frame}")


def _state_of(device: object) -> dict[str, object]:
    """A driver's state, counters and flow, as far as it reports them."""
    state = getattr(device, "state", "")
    said: dict[str, object] = {"state": getattr(state, "value", state)}
    said["reason"] = getattr(device, "reason", "")
    counters, flow = getattr(device, "counters", None), getattr(device, "flow", None)
    said |= {} if counters is None else vars(counters)
    return said | ({} if flow is None else flow.to_json())


# --------------------------------------------------------------------------------------------------
# How the mapping camera of a live dive sits in the vehicle, from whatever states it first.


def camera_mounting(
    config: Config, service: ServiceConfig, camera: object
) -> MountingConfig | None:
    """``fusion.camera``, else what ``camera`` (or its feed) states, else ``service.pose.mounting``
    where poses are sent; None: unknown.

    Raises:
        InputError, ConfigError: the camera states one that cannot be read.
    """
    pose = service.pose
    return config.fusion.camera or mounting_of(camera) or (pose.mounting if pose.enabled else None)


def record_mountings(
    recorder: Recorder, vehicle: VehicleConfig, cameras: Mapping[str, CameraSource]
) -> None:
    """State in a recording how the cameras sit, as far as the vehicle's configuration says it."""
    mapped = vehicle.service.camera or next(iter(cameras), None)
    for name, camera in cameras.items():
        known = mounting_of(camera)
        if name == mapped:
            known = camera_mounting(vehicle, vehicle.service, camera)
        recorder.record_mounting(name, known)
