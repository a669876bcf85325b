"""The live loop: tracks the newest frame, maps in parallel, publishes the results."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from aquaflow.config.service import ServiceConfig
from aquaflow.dive.run import DiveRun
from aquaflow.errors import AquaFlowError
from aquaflow.messages import Dropped, Frame
from aquaflow.service.feed import Feed
from aquaflow.service.health.counters import Counters
from aquaflow.service.health.degradation import Degradation, DegradationLevel
from aquaflow.service.health.heartbeats import Heartbeats
from aquaflow.service.health.pressure import Pressure
from aquaflow.service.health.state import Facts, Health, State, judged
from aquaflow.service.health.systemd import Notifier
from aquaflow.service.map_thread import MapThread
from aquaflow.tracking.frames import FrameClass, Tracked

log = logging.getLogger(__name__)

STAGE = "tracking"
"""Name of this thread among the heartbeats."""
IDLE_S = 0.25
"""Longest wait for a frame; then the loop sends its heartbeat as idle."""
BUSY_S = 0.01
"""The same while earlier frames wait for their poses: then one of them is processed."""
LATE_MS = 150.0
"""A frame that took longer from its arrival on is late, and mapping gives way; at 10 frames/s one
that found tracking idle is ready in 60 to 100 ms."""
PATIENCE_S = 2.0
"""Longest time without a frame before the state becomes WAITING."""
LOST_AFTER = 3
"""Frames in a row without a pose until the state is LOST; one may be a flake of marine snow."""
MOST_FAILURES = 10
"""Frames in a row that raise before the process exits: then the pictures are not the cause."""


class LiveLoop:
    """Runs until it is stopped, or until a recording ends."""

    def __init__(
        self,
        run: DiveRun,
        feed: Feed,
        maps: MapThread,
        config: ServiceConfig,
        heartbeats: Heartbeats,
        degradation: Degradation,
        pressure: Callable[[], Pressure],
        notifier: Notifier,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.run_, self.feed, self.maps, self.config = run, feed, maps, config
        self.heartbeats, self.degradation, self.notifier = heartbeats, degradation, notifier
        self.stopping = threading.Event()
        """Setting it ends the dive cleanly; may be done in a signal handler."""
        self.health, self.counters = Health(now_s), Counters(run.profiler, now_s)
        self.latest: Tracked | None = None
        """The newest frame that has a pose, without its picture."""
        self.picture: Frame | None = None
        """The newest frame, prepared or not, for the viewer."""
        self.pressure = pressure()
        self.watchers: list[Callable[[LiveLoop], None]] = []
        """Called after every frame and every idle moment; must not wait."""
        self._read_pressure, self._now_s = pressure, now_s
        self._frame_s = now_s()
        self._pictured = False
        self._ever_posed = any(tracked.T_wc is not None for tracked in run.results)
        self._unposed = LOST_AFTER
        """Frames in a row without a pose."""
        self._failed_in_a_row = 0

    def run(self) -> None:
        """Run the loop.

        Raises:
            AquaFlowError: the source failed, or frame after frame did.
        """
        self.feed.start()
        while not self.stopping.is_set() and not self.feed.newest.ended:
            self.take(self.feed.newest.take(IDLE_S if self._past is None else BUSY_S))
        if self.feed.failure is not None:
            raise AquaFlowError(f"{self.feed.failure}; the service ends, to be started anew")

    def take(self, frame: Frame | Dropped | None) -> None:
        """One turn: a frame, the note that one is missing, or an idle moment."""
        self.run_.samples(self.feed.latest_samples.taken())
        if frame is not None:
            self._frame_s, self._pictured = self._now_s(), True
        if isinstance(frame, Dropped):
            self.run_.drop(frame)
        elif frame is not None:
            self._frame(frame)
        elif self._past is not None:
            self._catch_up(self._past)
        self._tend()

    def stop(self, reason: str) -> None:
        """Set the state to stopping and notify systemd; telemetry of after the last frame is
        taken."""
        self.run_.samples(self.feed.latest_samples.taken())
        self.health.set(State.STOPPING, reason)
        self.heartbeats.retire(STAGE)  # from here on systemd's timeout of stopping counts
        self.notifier.stopping()
        self._notify_systemd()

    def status(self) -> dict[str, Any]:
        """Dropped-work and degradation counters, for health and metrics.json."""
        return {
            **self.counters.to_json(),
            "overtaken": self.feed.newest.overtaken,
            "level": self.degradation.level.words,
            "steps_down": self.degradation.steps_down,
            "steps_up": self.degradation.steps_up,
            "visits": {state.value: count for state, count in self.health.visits.items()},
            "left_out_of_the_map": dict(self.maps.left_out),
            "mapping_failures": self.maps.failures,
            "mapping_waits": self.maps.waiting,
            "mapping_rests": self.maps.rests,
            "stage_failures": self.run_.slam.failures.to_json(),
        }

    # --- one frame ------------------------------------------------------------------------------

    def _frame(self, frame: Frame) -> None:
        self.picture = frame
        if self.degradation.level is DegradationLevel.RECORDING_ONLY:
            self.run_.drop(
                Dropped(frame.index, frame.t_ns, f"recording only: {self.degradation.reason}")
            )
        else:
            self._track(frame)
        self.maps.late = self.counters.frame(frame.arrival_ns) > LATE_MS

    def _track(self, frame: Frame) -> None:
        try:
            decided = self.run_.frame(frame)
        # A bad frame never ends the dive (docs/architecture.md#numbers-stay-finite).
        except Exception as error:
            self._failed(frame, error)
            return
        self._failed_in_a_row = 0
        self.counters.classes.update(tracked.frame_class.value for tracked in decided)
        own = [tracked for tracked in decided if tracked.frame.index == frame.index]
        self._place(own[0] if own else None)

    @property
    def _past(self) -> Frame | None:
        """An earlier frame that waits for its pose until there is time."""
        return self.run_.slam.tracker.past

    def _catch_up(self, past: Frame) -> None:
        try:
            decided = self.run_.catch_up()
        except Exception as error:  # costs that frame
            self._failed(past, error)
            return
        self.counters.classes.update(tracked.frame_class.value for tracked in decided)

    def _place(self, tracked: Tracked | None) -> None:
        """Record whether the newest frame has a pose; a skipped frame does not count."""
        if tracked is not None and tracked.T_wc is not None:
            self.latest = tracked.bare()
            self._ever_posed, self._unposed = True, 0
        elif tracked is None or tracked.frame_class is not FrameClass.SKIPPED:
            self._unposed += 1

    def _failed(self, frame: Frame, error: Exception) -> None:
        self.counters.failures += 1
        self._failed_in_a_row += 1
        log.exception("frame %d failed", frame.index)
        self.run_.drop(Dropped(frame.index, frame.t_ns, f"failed: {error}"))
        if self._failed_in_a_row >= MOST_FAILURES:
            raise AquaFlowError(
                f"{MOST_FAILURES} frames in a row failed, the last with: {error}; see log.jsonl"
            ) from error

    # --- between frames -------------------------------------------------------------------------

    def _tend(self) -> None:
        self.heartbeats.beat(STAGE)
        contain = self.run_.slam.failures.contain
        with contain("resource check"):
            self.degradation.update(self._need)
            self.counters.update()
        with contain("health state"):
            self.health.set(*judged(self._facts()))
        for watch in self.watchers:
            with contain(f"service: {getattr(watch, '__qualname__', type(watch).__name__)}"):
                watch(self)
        with contain("notification of systemd"):
            self._notify_systemd()

    def _need(self) -> str | None:
        self.pressure = self._read_pressure()
        return self.pressure.need(self.config.limits)

    def _facts(self) -> Facts:
        devices = self.feed.describe()
        cameras = [device for device in devices.values() if device["kind"] == "camera"]
        return Facts(
            self._now_s() - self._frame_s,
            PATIENCE_S,
            self._pictured,
            str(cameras[0]["reason"]) if cameras else "",
            self._unposed < LOST_AFTER,
            self._ever_posed,
            self.run_.slam.tracker.monitor.trouble,
            self._troubles(devices),
        )

    def _troubles(self, devices: dict[str, dict[str, object]]) -> list[str]:
        troubles = []
        if self.degradation.level is not DegradationLevel.FULL:
            troubles.append(f"{self.degradation.level.words}: {self.degradation.reason}")
        if self.pressure.disk_is_full(self.config.limits):
            troubles.append(f"disk full: {self.pressure.disk_free_mb:.0f} MB left")
        if self.maps.failing:
            troubles.append(f"mapping fails: {self.maps.last_failure}")
        troubles += self.run_.slam.failures.repeated()
        for name, device in devices.items():
            if device["kind"] == "link" and device["state"] != "connected":
                troubles.append(f"link '{name}': {device['state']}")
            if device["kind"] == "recorder" and device["state"] != "recording":
                troubles.append(f"not recording: {device['state']}")
        return troubles

    def _notify_systemd(self) -> None:
        """Send READY to systemd once a sensor answered or its absence was declared; the watchdog is
        fed only here, and only while mapping is alive too."""
        state = self.health.state
        if state not in (State.STARTING, State.STOPPING):
            self.notifier.ready()
        self.notifier.status(f"{state.value}: {self.health.reason}")
        if self.heartbeats.hung(self.config.hang_s) is None:
            self.notifier.alive()
