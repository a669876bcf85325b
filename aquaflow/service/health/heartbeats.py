"""Heartbeats of each stage and the watchdog that checks them.

A thread of Python's cannot be killed. A stage that hangs therefore takes the process down, and
whoever started it (systemd, Docker) starts it anew; the dive resumes from its checkpoint.
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


class Beats:
    """When each stage last showed that it lives."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._last_s: dict[str, float] = {}

    def beat(self, stage: str) -> None:
        """Work was done, or there is none: said by the stage itself, never on its behalf."""
        self._last_s[stage] = self._now_s()

    def retire(self, stage: str) -> None:
        """The stage has ended as it should; its silence means nothing any more."""
        self._last_s.pop(stage, None)

    def ages_s(self) -> dict[str, float]:
        """Seconds since each stage's last beat."""
        now = self._now_s()
        return {stage: now - last for stage, last in dict(self._last_s).items()}

    def hung(self, longer_than_s: float) -> str | None:
        """The stage that was silent for longest, if that is too long."""
        ages = self.ages_s()
        stage = max(ages, key=lambda name: ages[name], default=None)
        return stage if stage is not None and ages[stage] > longer_than_s else None


def give_up(stage: str, silent_s: float) -> None:
    """Leave where every thread is on stderr, and end the process at once."""
    log.critical("%s gave no sign of life for %.0f s: the process gives up", stage, silent_s)
    faulthandler.dump_traceback(file=sys.stderr, all_threads=True)
    os._exit(EXIT_HUNG)


class Guard:
    """Looks at the beats from a thread of its own; what it can do is end the process."""

    def __init__(
        self,
        beats: Beats,
        hang_s: float,
        hung: Callable[[str, float], None] = give_up,
        look_s: float = 1.0,
    ) -> None:
        self._beats, self._hang_s, self._hung, self._look_s = beats, hang_s, hung, look_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="guard", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._closing.set()
        self._thread.join(self._look_s + 1.0)

    def _run(self) -> None:
        while not self._closing.wait(self._look_s):
            stage = self._beats.hung(self._hang_s)
            if stage is not None:
                self._hung(stage, self._beats.ages_s().get(stage, self._hang_s))
                return
