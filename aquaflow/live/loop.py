"""The live loop: tracks the newest frame, maps in parallel, publishes the results."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors import AquaFlowError
from aquaflow.base.errors.failures import Failures
from aquaflow.config.service import LimitsConfig, ServiceConfig
from aquaflow.dive.run import DiveRun
from aquaflow.live.control import ServiceControl
from aquaflow.live.feed import Feed
from aquaflow.live.health import state
from aquaflow.live.health.degradation import Degradation, DegradationLevel
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.pressure import Need, Pressure, Shortage
from aquaflow.live.health.state import Facts, Judgement, ServiceState, ServiceWarning, judge
from aquaflow.live.map_thread import MapThread
from aquaflow.live.service_status import Counters
from aquaflow.tracking.consistency import InconsistentKeyframe
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.types import Dropped, Frame

log = logging.getLogger(__name__)

STAGE = "tracking"
"""Name of this thread among the heartbeats."""
IDLE_S = 0.25
"""Longest wait for a frame; then the loop sends its heartbeat as idle."""
BUSY_S = 0.01
"""The same while earlier frames wait for their poses: then one that was placed is taken."""
LATE_MS = 150.0
"""A frame that took longer from its arrival on is late, and work beside tracking gives way; at 10
frames/s one that found tracking idle is ready in 60 to 100 ms."""
PATIENCE_S = 2.0
"""Longest time without a frame before the state becomes WAITING."""
LOST_AFTER = 3
"""Frames in a row without a pose until the state is LOST; one may be a flake of marine snow."""
MOST_FAILURES = 10
"""Frames in a row that raise before the process exits: then the pictures are not the cause."""
PAUSED = "the pilot paused the dive: pictures are shown, not mapped"
"""The reason of the state PAUSED."""


class LiveLoop:
    """Runs until the dive shall end, or a recording does; obeys the pilot."""

    def __init__(
        self,
        run: DiveRun,
        feed: Feed,
        maps: MapThread,
        config: ServiceConfig,
        vitals: ServiceHealth,
        control: ServiceControl,
        pressure: Callable[[], Pressure],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.dive_run, self.feed, self.maps, self.config = run, feed, maps, config
        self.vitals, self.control = vitals, control
        self.health, self.heartbeats = vitals.health, vitals.heartbeats
        self.degradation, self.counters = vitals.degradation, Counters(run.profiler, now_s)
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
        self._overtaken_before = feed.newest.overtaken
        self._ever_posed = any(T_kf is not None for _, T_kf in run.slam.frames)
        self._unposed = LOST_AFTER
        """Frames in a row without a pose."""
        self._failed_in_a_row = 0
        self._gpu_full = 0
        """How often mapping had found the GPU's memory full at the last turn."""

    def run(self) -> None:
        """Run the loop.

        Raises:
            AquaFlowError: the source failed, or frame after frame did.
        """
        self.feed.start()
        while not self.control.dive_ends and not self.feed.newest.ended:
            self.take(self.feed.take(IDLE_S if self._past is None else BUSY_S))
        if self.feed.failure is not None:
            raise AquaFlowError(f"{self.feed.failure}; the service ends, to be started anew")

    def take(self, frame: Frame | Dropped | None) -> None:
        """One turn: a frame, the note that one is missing, or an idle moment."""
        self.dive_run.samples(self.feed.latest_samples.take_new())
        if frame is not None:
            self._frame_s, self._pictured = self._now_s(), True
        if self.control.paused:
            self.picture = frame if isinstance(frame, Frame) else self.picture
            frame = None
        if isinstance(frame, Dropped):
            self.dive_run.drop(frame)
        elif frame is not None:
            self._frame(frame)
        else:
            self.maps.lateness.times = 0.0
            if self._past is not None:
                self._catch_up(self._past)
        self._tend()

    def catch_up(self, until: Deadline) -> None:
        """Poses of the frames that wait for idle moments, as many as there is time for."""
        while self._past is not None and not until.over:
            self._catch_up(self._past)
            self.dive_run.slam.take_finished(wait=True)

    def end(self) -> None:
        """After the last turn: telemetry of after the last frame is taken."""
        self.maps.lateness.times = 0.0
        self.dive_run.samples(self.feed.latest_samples.take_new())
        self.heartbeats.retire(STAGE)

    def status(self) -> dict[str, Any]:
        """Dropped-work and degradation counters, for health and metrics.json."""
        return {
            **self.counters.to_json(),
            "overtaken": self.feed.newest.overtaken - self._overtaken_before,
            "level": self.degradation.level.words,
            "steps_down": self.degradation.steps_down,
            "steps_up": self.degradation.steps_up,
            "visits": {state.value: count for state, count in self.health.visits.items()},
            "left_out_of_the_map": dict(self.maps.left_out),
            "mapped_without_steps": self.maps.without_steps,
            "mapping_failures": self.maps.failures,
            "mapping_waits": self.maps.waiting,
            "mapping_rests": self.maps.lateness.rests,
            "stage_failures": self.dive_run.slam.failures.to_json(),
        }

    def notes(self) -> list[str]:
        """What the dive lacks because the computer was too slow, in sentences."""
        notes, slow_s, absent = [], self.counters.slow_s, self.maps.left_out
        if slow_s > 0.0:
            notes.append(
                f"tracking was more than half a second behind the camera for {slow_s:.0f} s: the "
                "computer is too slow for these settings"
            )
        if absent:
            reasons = ", ".join(f"{count} for: {reason}" for reason, count in absent.items())
            notes.append(f"{absent.total()} tracked frames are not in the map ({reasons})")
        return notes

    # --- one frame ------------------------------------------------------------------------------

    def _frame(self, frame: Frame) -> None:
        self.picture = frame
        if self.degradation.level is DegradationLevel.RECORDING_ONLY:
            self.dive_run.drop(
                Dropped(frame.index, frame.t_ns, f"recording only: {self.degradation.reason}")
            )
        else:
            self._track(frame)
        self.maps.lateness.times = self.counters.frame(frame.arrival_ns) / LATE_MS

    def _track(self, frame: Frame) -> None:
        try:
            decided = self.dive_run.frame(frame)
        # A bad frame never ends the dive (docs/architecture.md#numbers-stay-finite).
        except Exception as error:
            self._record_failure(frame, error)
            return
        self._failed_in_a_row = 0
        self.counters.classes.update(tracked.frame_class.value for tracked in decided)
        own = [tracked for tracked in decided if tracked.frame.index == frame.index]
        self._place(own[0] if own else None)

    @property
    def _past(self) -> Frame | None:
        """An earlier frame that waits for its pose until there is time."""
        return self.dive_run.slam.tracker.past

    def _catch_up(self, past: Frame) -> None:
        try:
            decided = self.dive_run.catch_up()
        except Exception as error:  # costs that frame
            self._record_failure(past, error)
            return
        self.counters.classes.update(tracked.frame_class.value for tracked in decided)

    def _place(self, tracked: Tracked | None) -> None:
        """Record whether the newest frame has a pose; a skipped frame does not count."""
        if tracked is not None and tracked.T_wc is not None:
            self.latest = tracked.bare()
            self._ever_posed, self._unposed = True, 0
        elif tracked is None or tracked.frame_class is not FrameClass.SKIPPED:
            self._unposed += 1

    def _record_failure(self, frame: Frame, error: Exception) -> None:
        self.counters.failures += 1
        self._failed_in_a_row += 1
        log.exception("frame %d failed", frame.index)
        self.dive_run.drop(Dropped(frame.index, frame.t_ns, f"failed: {error}"))
        if self._failed_in_a_row >= MOST_FAILURES:
            raise AquaFlowError(
                f"{MOST_FAILURES} frames in a row failed, the last with: {error}; see log.jsonl"
            ) from error

    # --- between frames -------------------------------------------------------------------------

    def _tend(self) -> None:
        self.heartbeats.beat(STAGE)
        contain = self.dive_run.slam.failures.contain
        with contain("resource check"):
            self._give_way_to_mapping()
            self.degradation.update(self._need)
            self.counters.update()
        with contain("health state"):
            paused = self.control.paused
            self.health.set(
                *(Judgement(ServiceState.PAUSED, PAUSED) if paused else judge(self._facts()))
            )
        self.tell_watchers()
        with contain("notification of systemd"):
            self.vitals.notify()

    def tell_watchers(self) -> None:
        """Let those who look on see the service as it is now."""
        contain = self.dive_run.slam.failures.contain
        for watch in self.watchers:
            with contain(f"service: {getattr(watch, '__qualname__', type(watch).__name__)}"):
                watch(self)

    def _give_way_to_mapping(self) -> None:
        """What found no memory on the GPU was left out; less is asked for from now on."""
        full = self.dive_run.slam.failures.device_full
        if full > self._gpu_full:
            self.degradation.give_way(Need(Shortage.GPU_MEMORY, "the GPU's memory was full"))
        self._gpu_full = full

    def _need(self) -> Need | None:
        self.pressure = self._read_pressure()
        return self.pressure.need(self.config.limits)

    def _facts(self) -> Facts:
        devices, slam = self.feed.describe(), self.dive_run.slam
        return Facts(
            self._now_s() - self._frame_s,
            PATIENCE_S,
            self._pictured,
            silent_camera(devices),
            self._unposed < LOST_AFTER,
            self._ever_posed,
            inconsistency(slam.tracker.monitor.trouble),
            [
                *of_the_machine(self.degradation, self.pressure, self.config.limits),
                *of_the_pace(self.counters),
                *of_the_stages(self.maps, slam.failures),
                *of_the_devices(devices),
            ],
        )


# --------------------------------------------------------------------------------------------------
# Why the service works with less than everything: for its page, and for the pilot.

Devices = Mapping[str, Mapping[str, object]]


def silent_camera(devices: Devices) -> ServiceWarning:
    """Warning of the camera that maps, which is the first."""
    for name, device in devices.items():
        if device["kind"] == "camera":
            return ServiceWarning(str(device["reason"]), state.no_picture(name))
    return ServiceWarning("", state.OF_STATE[ServiceState.WAITING])


def inconsistency(found: InconsistentKeyframe | None) -> ServiceWarning | None:
    """Warning of a finding of the monitor of consistency."""
    return None if found is None else ServiceWarning(str(found), state.OF_CAUSE[found.cause])


def of_the_machine(
    degradation: Degradation, pressure: Pressure, limits: LimitsConfig
) -> list[ServiceWarning]:
    """Warnings of memory, heat and disk."""
    troubles, level, need = [], degradation.level, degradation.need
    if level is not DegradationLevel.FULL and need is not None:
        sentence = state.doing_less(level, need.shortage)
        troubles.append(ServiceWarning(f"{level.words}: {need.reason}", sentence))
    if pressure.disk_is_full(limits):
        full = f"disk full: {pressure.disk_free_mb:.0f} MB left"
        troubles.append(ServiceWarning(full, state.DISK_FULL))
    return troubles


def of_the_pace(counters: Counters) -> list[ServiceWarning]:
    """Warning of tracking that falls behind, whatever gives way to it."""
    if not counters.slow:
        return []
    lag_s = 1e-3 * counters.recent_lag_ms
    reason = (
        f"tracking is {lag_s:.1f} s behind the camera and takes {counters.fps:.1f} "
        "pictures a second: the computer is too slow for these settings; the preset small asks "
        "for less"
    )
    return [ServiceWarning(reason, state.TOO_SLOW)]


def of_the_stages(maps: MapThread, failures: Failures) -> list[ServiceWarning]:
    """Warnings of what raises again and again."""
    troubles = []
    if maps.failing:
        troubles.append(ServiceWarning(f"mapping fails: {maps.last_failure}", state.MAPPING_FAILS))
    troubles += [ServiceWarning(each, state.STAGE_FAILS) for each in failures.list_repeated()]
    return troubles


def of_the_devices(devices: Devices) -> list[ServiceWarning]:
    """Warnings of links that are silent, and a recorder that ended."""
    troubles = []
    for name, device in devices.items():
        if device["kind"] == "link" and device["state"] != "connected":
            reason = f"link '{name}': {device['reason'] or device['state']}"
            lost = device["state"] == "lost"
            troubles.append(ServiceWarning(reason, state.silent_link(name, lost)))
        if device["kind"] == "recorder" and device["state"] != "recording":
            reason = f"not recording: {device['reason']}"
            troubles.append(ServiceWarning(reason, state.NOT_RECORDING))
    return troubles
