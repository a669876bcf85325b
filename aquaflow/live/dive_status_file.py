"""How a live dive stands, in its dive.json: written when that changes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

from aquaflow.base.errors.failures import Failures
from aquaflow.base.storage.dive_status import DiveState, DiveStatus
from aquaflow.config.stage import MountingConfig
from aquaflow.live.clock_reading import ClockReading
from aquaflow.live.loop import LiveLoop
from aquaflow.sources.newest import OLDEST_NS


class DiveStatusFile:
    """A watcher of the loop: the pilot pauses the dive, and goes on with it."""

    def __init__(
        self,
        dive: Path,
        failures: Failures,
        mounting: MountingConfig | None,
        before: DiveStatus | None,
        paused: Callable[[], None] = lambda: None,
    ) -> None:
        """``before``: of a dive that goes on; ``paused``: called when the pilot pauses it."""
        self._dive, self._failures, self._paused = dive, failures, paused
        begun_utc = _utc(time.time_ns()) if before is None else before.begun_utc
        stated = None if mounting is None else mounting.model_dump(mode="json")
        self.was_paused = before is not None and before.paused
        """The pilot paused it in a process before."""
        boot = ClockReading.now().boot
        self.status = DiveStatus(DiveState.OPEN, self.was_paused, begun_utc, boot, stated)
        self._write()

    def update(self, loop: LiveLoop) -> None:
        """Called after every turn of the loop."""
        paused = loop.control.paused
        if paused is not self.status.paused:
            self.status = replace(self.status, paused=paused)
            self._write()
            if paused:
                self._paused()

    def set(self, state: DiveState) -> None:
        """The dive stands otherwise from here on."""
        self.status = replace(self.status, state=state)
        self._write()

    def _write(self) -> None:
        with self._failures.contain("writing dive.json", full_disk=True):
            self.status.write(self._dive)


def _utc(wall_ns: int) -> str | None:
    """In ISO 8601; None of a clock that was never set."""
    if wall_ns < OLDEST_NS:
        return None
    moment = datetime.fromtimestamp(wall_ns // 1_000_000_000, timezone.utc)
    return moment.isoformat().replace("+00:00", "Z")
