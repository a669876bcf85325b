"""A recording from beginning to end: every source is read in its own thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol, TypeAlias, runtime_checkable

from aquaflow.base.errors import AquaFlowError
from aquaflow.live.clock_reading import WallClock
from aquaflow.live.recorder.recorder import Recorder
from aquaflow.recordings.playback import Event, Playback, arrival_of, delay_event
from aquaflow.sources import CameraSource, RawTap, TelemetrySource
from aquaflow.types import Dropped, Frame, TelemetrySample

log = logging.getLogger(__name__)

LOOK_S = 0.1
"""How soon an end is noticed."""

CLOSE_S = 5.0
"""Longest wait for a source to end; a device's library that hangs is left behind."""

Pump: TypeAlias = Callable[[], None]
Progress: TypeAlias = Callable[[str, int, int | None], None]


class RecordingSession:
    """Pumps sources into a recorder until they end, time is up, or it is stopped."""

    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder
        self.stopping = threading.Event()
        """Setting it ends the recording cleanly; may be done in a signal handler."""
        self.notes: list[str] = []
        self._pumps: list[tuple[str, Pump]] = []
        self._endless: list[tuple[str, Pump]] = []
        self._closing: list[Callable[[], None]] = []

    def add_live(
        self, cameras: Mapping[str, CameraSource], telemetry: Sequence[TelemetrySource]
    ) -> None:
        """Record devices; a camera that has an IMU is a telemetry source too. With them the
        computer's clock is recorded."""
        for name, camera in cameras.items():
            self._pumps.append((f"camera '{name}'", self._camera_pump(name, camera)))
            if isinstance(camera, HasSamples):
                self._pumps.append((f"IMU of '{name}'", self._telemetry_pump(camera)))
            self._closing.append(camera.close)
        for source in telemetry:
            self._pumps.append(("telemetry", self._telemetry_pump(source)))
            self._closing.append(source.close)
        clock = WallClock()
        self._endless.append(("wall clock", self._telemetry_pump(clock)))
        self._closing.append(clock.close)

    def add_playback(
        self, name: str, playback: Playback, telemetry: Sequence[TelemetrySource]
    ) -> None:
        """Record a recording as if it happened now; ``name`` is the camera's.

        Moments of exposure and measurement keep their distances; arrivals are what they are here.
        """

        def tap(link: str, arrival_ns: int, data: bytes) -> None:
            self.recorder.raw(link, time.monotonic_ns(), data)

        for source in telemetry:
            if isinstance(source, TapsBytes):
                source.tap_bytes(tap)

        def pump() -> None:
            shift_ns: int | None = None
            for event in playback.events():
                if self.stopping.is_set():
                    return
                now_ns = time.monotonic_ns()
                shift_ns = now_ns - arrival_of(event) if shift_ns is None else shift_ns
                self._hand_over(name, delay_event(event, shift_ns, now_ns))

        try:
            self.recorder.record_mounting(name, playback.stated_mounting())
        except AquaFlowError as error:
            self.notes.append(str(error))
        self._pumps.append((f"recording '{name}'", pump))
        self._closing.append(playback.close)

    def run(self, seconds: float | None = None, progress: Progress | None = None) -> None:
        """Record; returns when all is on the disk. Why it ended early is in the status."""
        threads, endless = (
            [
                threading.Thread(target=self._guard, args=pump, name=pump[0], daemon=True)
                for pump in pumps
            ]
            for pumps in (self._pumps, self._endless)
        )
        began = time.monotonic()
        for thread in threads + endless:
            thread.start()
        while any(thread.is_alive() for thread in threads) and not self.stopping.wait(LOOK_S):
            elapsed = time.monotonic() - began
            if progress is not None:
                progress("record", int(elapsed), None if seconds is None else int(seconds))
            if self.recorder.status.stopped or (seconds is not None and elapsed >= seconds):
                break
        self.stopping.set()
        for close in self._closing:
            close()
        for thread in threads + endless:
            thread.join(CLOSE_S)
        self.recorder.close()

    def _hand_over(self, camera: str, event: Event) -> None:
        if isinstance(event, (Frame, Dropped)):
            self.recorder.frame(camera, event)
        else:
            self.recorder.sample(event)

    def _camera_pump(self, name: str, camera: CameraSource) -> Pump:
        def pump() -> None:
            for frame in camera.frames():
                self.recorder.frame(name, frame)

        return pump

    def _telemetry_pump(self, source: HasSamples) -> Pump:
        def pump() -> None:
            for sample in source.samples():
                self.recorder.sample(sample)

        return pump

    def _guard(self, name: str, pump: Pump) -> None:
        """One source that fails costs its own data; the others go on."""
        try:
            pump()
        except Exception as error:
            log.exception("%s failed", name)
            self.notes.append(f"{name} failed: {error}")


@runtime_checkable
class HasSamples(Protocol):
    """A telemetry source, or a camera with an IMU."""

    def samples(self) -> Iterator[TelemetrySample]: ...


@runtime_checkable
class TapsBytes(Protocol):
    """A recorded telemetry source that knows the bytes its samples came from."""

    def tap_bytes(self, tap: RawTap) -> None: ...
