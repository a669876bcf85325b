"""Heartbeats of each stage and the watchdog that checks them.

A Python thread cannot be killed. A stage that hangs therefore takes the process down, and
its supervisor (systemd, Docker) restarts it; the dive resumes from its checkpoint.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import sys
import threading
import time
from collections.abc import Callable

log = logging.getLogger(__name__)

EXIT_HUNG = 70
"""Exit status of a process that gave up on one of its stages (EX_SOFTWARE of sysexits.h)."""


class Heartbeats:
    """Time of the last heartbeat of each stage."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._last_s: dict[str, float] = {}

    def beat(self, stage: str, ahead_s: float = 0.0) -> None:
        """The stage worked, or is idle; called by the stage itself only. One that may be silent for
        a known time says so with ``ahead_s``."""
        self._last_s[stage] = self._now_s() + ahead_s

    def retire(self, stage: str) -> None:
        """The stage has ended normally; stop checking it."""
        self._last_s.pop(stage, None)

    def ages_s(self) -> dict[str, float]:
        """Seconds since each stage's last heartbeat."""
        now = self._now_s()
        return {stage: now - last for stage, last in dict(self._last_s).items()}

    def find_hung_stage(self, longer_than_s: float) -> str | None:
        """The stage that was silent for longest, if longer than ``longer_than_s``."""
        ages = self.ages_s()
        stage = max(ages, key=lambda name: ages[name], default=None)
        return stage if stage is not None and ages[stage] > longer_than_s else None


def give_up(stage: str, silent_s: float) -> None:
    """Write the stack of every thread to stderr and end the process at once."""
    log.critical("%s sent no heartbeat for %.0f s: the process exits", stage, silent_s)
    faulthandler.dump_traceback(file=sys.stderr, all_threads=True)
    os._exit(EXIT_HUNG)


class Watchdog:
    """Checks the heartbeats in its own thread; ends the process when a stage hangs."""

    def __init__(
        self,
        heartbeats: Heartbeats,
        hang_s: float,
        hung: Callable[[str, float], None] = give_up,
        look_s: float = 1.0,
    ) -> None:
        self._heartbeats, self._hang_s, self._hung, self._look_s = heartbeats, hang_s, hung, look_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop checking."""
        self._closing.set()
        self._thread.join(self._look_s + 1.0)

    def _run(self) -> None:
        while not self._closing.wait(self._look_s):
            stage = self._heartbeats.find_hung_stage(self._hang_s)
            if stage is not None:
                self._hung(stage, self._heartbeats.ages_s().get(stage, self._hang_s))
                return
