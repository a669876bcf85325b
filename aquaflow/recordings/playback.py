"""Recorded streams in time: merged in the order of arrival; paced, or as fast as they are taken."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, dropwhile
from typing import TypeAlias, TypeVar

from aquaflow.base.errors.failures import Failures
from aquaflow.config import SourceConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.sources import CameraSource, TelemetrySource, mounting_of
from aquaflow.types import Dropped, Frame, TelemetrySample

Event: TypeAlias = Frame | Dropped | TelemetrySample


class Playback:
    """A camera and telemetry as one series of events, the same each time.

    Step by step with ``next(events)``: nothing is read ahead of the caller, whatever the speed.
    """

    def __init__(
        self,
        camera: CameraSource | None,
        telemetry: Sequence[TelemetrySource],
        speed: float | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep_s: Callable[[float], None] = time.sleep,
        failures: Failures | None = None,
    ) -> None:
        """``speed`` 1 plays in real time, 4 four times faster, None without waiting.

        Telemetry that fails is counted in ``failures``, and ends; the pictures go on.
        """
        self._failures = failures or Failures()
        self._camera, self._telemetry, self._speed = camera, telemetry, speed
        self._now_ns, self._sleep_s = now_ns, sleep_s

    def events(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Event]:
        """Everything in the order of arrival; of equals the picture first, then as listed.

        From a later ``start`` on, telemetry of before its picture is left out.
        """
        pictures = iter(() if self._camera is None else self._camera.frames(every, start, stop))
        since_ns = None
        if start > 0 and (first := next(pictures, None)) is not None:
            since_ns, pictures = arrival_of(first), chain([first], pictures)
        samples = (_since(since_ns, self._samples(source)) for source in self._telemetry)
        streams: list[Iterator[Event]] = [pictures, *samples]
        began: tuple[int, int] | None = None
        for event in heapq.merge(*streams, key=arrival_of):
            # The clock starts with the first event, not with the reading of it.
            began = (self._now_ns(), arrival_of(event)) if began is None else began
            if self._speed is not None:
                due_ns = began[0] + (arrival_of(event) - began[1]) / self._speed
                wait_s = (due_ns - self._now_ns()) * 1e-9
                if wait_s > 0:
                    self._sleep_s(wait_s)
            yield event

    @property
    def frame_count(self) -> int | None:
        """Number of the camera's frames, where it knows it."""
        return None if self._camera is None else self._camera.frame_count

    def stated_mounting(self) -> MountingConfig | None:
        """Stated mounting of the camera; see :func:`aquaflow.sources.mounting_of`."""
        return mounting_of(self._camera)

    def _samples(self, source: TelemetrySource) -> Iterator[TelemetrySample]:
        with self._failures.contain("telemetry"):
            yield from source.samples()

    def close(self) -> None:
        """Close every source."""
        for source in [self._camera, *self._telemetry]:
            if source is not None:
                source.close()


def _since(since_ns: int | None, samples: Iterator[TelemetrySample]) -> Iterator[TelemetrySample]:
    if since_ns is None:
        return samples
    return dropwhile(lambda sample: sample.arrival_ns < since_ns, samples)


def arrival_of(event: Event) -> int:
    """When the event reaches its consumer, ns; a missing picture when it would have been taken."""
    return event.t_ns if isinstance(event, Dropped) else event.arrival_ns


def delay_event(event: Event, shift_ns: int, now_ns: int) -> Event:
    """The same event ``shift_ns`` later, as it reaches this process at ``now_ns``."""
    if isinstance(event, Dropped):
        return replace(event, t_ns=event.t_ns + shift_ns)
    return replace(event, t_ns=event.t_ns + shift_ns, arrival_ns=now_ns)


# --------------------------------------------------------------------------------------------------
# Past frames on which a reader raises; only these frames are lost.

Read = TypeVar("Read", bound=Event)

MOST_UNREADABLE = 5
"""Frames in a row that a recording fails on until the rest is given up."""


def read_past_failures(
    read: Callable[[int], Iterator[Read]],
    start: int,
    source: SourceConfig,
    frame_count: int | None,
    failures: Failures,
    give_up: Callable[[int], object],
) -> Iterator[Read | Dropped]:
    """Events of ``read(start)``; after a frame on which it raises, reading continues with the next.

    ``give_up`` is called with the next frame after ``MOST_UNREADABLE`` failures in a row.

    Raises:
        Exception: the error of the reader, if the recording fails before its first frame.
    """
    ends = [end for end in (frame_count, source.stop) if end is not None]
    t_ns, failed_in_a_row, any_read = 0, 0, False
    events = read(start)
    while failed_in_a_row < MOST_UNREADABLE:
        with failures.contain("reading", start) as reading:
            event = next(events, None)
        if reading.error is not None:
            if not any_read:
                raise reading.error
            if ends and start >= min(ends):
                return  # closing failed after the last frame
            failed_in_a_row += 1
            yield Dropped(start, t_ns, "reading failed, see log.jsonl")
            start += source.every
            events = read(start)
            continue
        if event is None:
            return
        if isinstance(event, (Frame, Dropped)):
            any_read, failed_in_a_row = True, 0
            start, t_ns = event.index + source.every, event.t_ns
        yield event
    give_up(start)
