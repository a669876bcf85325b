"""Deliverables while the dive goes on: a container is killed, not stopped.

They are written in the mapping thread, behind the requests that wait there, in parts with mapping
in between. What they cost is measured, and bounds how often they are written.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.dive.interim import Interim
from aquaflow.dive.run import DiveRun
from aquaflow.live.map_thread import Job, MapThread
from aquaflow.mapping.work import MIN_VIEWS, OwnedMaps

log = logging.getLogger(__name__)

SHARE = 0.03
"""Of one core, at most, for writing deliverables: with a million Gaussians 1.7 s in every 57."""


class DeliverableUpdater:
    """A watcher of the loop; :meth:`write_if_due` is called after every turn of it."""

    def __init__(
        self,
        run: DiveRun,
        maps: MapThread,
        every_s: float,
        now_s: Callable[[], float] = time.monotonic,
        cpu_s: Callable[[], float] = time.thread_time,
    ) -> None:
        """``cpu_s``: what the calling thread has used."""
        self.written = 0
        """Times that all of them were written."""
        self.took_s = 0.0
        """CPU time of the mapping thread for the last ones."""
        self._run, self._maps, self._every_s = run, maps, every_s
        self._now_s, self._cpu_s = now_s, cpu_s
        self._due_s = now_s() + every_s
        self._written_s: float | None = None
        self._writing = self._ended = False

    def write_if_due(self, disk_is_full: bool) -> None:
        """Begin to write, if it is time, nothing is being written, there is room and a map."""
        if self._now_s() < self._due_s or self._writing or self._ended or disk_is_full:
            return
        if len(self._run.slam.frames) < MIN_VIEWS or not self._maps.mappers:
            return
        self._writing, self.took_s = True, 0.0
        moment = Interim(self._run)
        parts: list[tuple[str, Job]] = [
            ("write the maps", lambda maps: moment.write_maps(maps.mappers)),
            ("write the path", lambda _: moment.write_path()),
            ("check the calibration", lambda _: self._run.check_calibration()),
            ("write the report", lambda maps: moment.write_report(maps.mappers)),
        ]
        self._post(parts, self._now_s())

    def write_soon(self) -> None:
        """Write at the next turn."""
        self._due_s = self._now_s()

    def end(self) -> None:
        """The dive's own deliverables come: what waits is not written."""
        self._ended = True

    def to_json(self) -> dict[str, Any]:
        """Counts for /health."""
        age_s = None if self._written_s is None else round(self._now_s() - self._written_s, 1)
        return {"written": self.written, "age_s": age_s, "cpu_s": round(self.took_s, 3)}

    def _post(self, parts: list[tuple[str, Job]], began_s: float) -> None:
        """The first of the parts, behind what waits for mapping; then the next."""
        (name, write), *rest = parts

        def work(maps: OwnedMaps) -> None:
            if self._ended:
                return
            before_s, failures = self._cpu_s(), maps.failures
            try:
                self._attempt(failures, name, lambda: write(maps))
            finally:
                self.took_s += self._cpu_s() - before_s
                self._next(rest, began_s)

        self._maps.later(name, work)

    def _next(self, rest: list[tuple[str, Job]], began_s: float) -> None:
        if rest:
            self._post(rest, began_s)
            return
        self.written, self._written_s = self.written + 1, began_s
        self._due_s = began_s + max(self._every_s, self.took_s / SHARE)
        self._writing = False

    def _attempt(self, failures: Failures, name: str, write: Callable[[], None]) -> None:
        """What fails is counted; a file that found no room is written the next time."""
        try:
            with failures.contain(name):
                write()
        except InputError as error:
            log.warning("%s", error)
