"""Graceful degradation: load-shedding levels, entered and left by machine pressure."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from enum import IntEnum

from aquaflow.config.service import LimitsConfig

log = logging.getLogger(__name__)


class Level(IntEnum):
    """What is still done, from everything down."""

    FULL = 0
    FEWER_STEPS = 1
    """The map takes a quarter of the steps, and none in idle time."""
    SMALLER_IMAGES = 2
    """New views of the map at half the width: a quarter of the memory and of the work."""
    TRACKING_ONLY = 3
    """Poses go on, the map stays as it is."""
    RECORDING_ONLY = 4
    """Frames go to the recorder, if there is one, and no further."""

    @property
    def words(self) -> str:
        """The name for messages."""
        return self.name.lower().replace("_", " ")


class Ladder:
    """One step down at each look that finds a need, one up after a calm while."""

    def __init__(self, config: LimitsConfig, now_s: Callable[[], float] = time.monotonic) -> None:
        self.level = Level.FULL
        self.reason = ""
        """Why it is not the full level."""
        self.steps_down = 0
        self.steps_up = 0
        self._config, self._now_s = config, now_s
        self._looked_s = now_s()
        self._needed_s = now_s()

    def look(self, need: Callable[[], str | None]) -> None:
        """Ask ``need`` now and then: a clause that says what runs short, or None."""
        now = self._now_s()
        if now - self._looked_s < self._config.look_s:
            return
        self._looked_s = now
        short = need()
        if short is not None:
            self._needed_s, self.reason = now, short
            if self.level < Level.RECORDING_ONLY:
                self.steps_down += 1
                self._move(Level(self.level + 1), short)
        elif self.level > Level.FULL and now - self._needed_s >= self._config.calm_s:
            self._needed_s = now
            self.steps_up += 1
            self._move(Level(self.level - 1), "calm again")
            self.reason = "" if self.level is Level.FULL else self.reason

    def _move(self, level: Level, why: str) -> None:
        log.warning("from '%s' to '%s': %s", self.level.words, level.words, why)
        self.level = level
