"""Graceful degradation: load-shedding levels, entered and left by machine pressure."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from enum import IntEnum

from aquaflow.config.service import LimitsConfig
from aquaflow.live.health.pressure import Need, Shortage

log = logging.getLogger(__name__)


class DegradationLevel(IntEnum):
    """What the service still does; a higher level does less."""

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


DEEPEST = {Shortage.GPU_MEMORY: DegradationLevel.TRACKING_ONLY}
"""The level below which doing less does not help: once the map, which takes the GPU's memory, no
longer grows, nothing more does."""


def deepest(short: Need) -> DegradationLevel:
    """The last level that helps against a shortage."""
    return DEEPEST.get(short.shortage, DegradationLevel.RECORDING_ONLY)


class Degradation:
    """The level: one down at each check that finds a shortage, one up after a calm period."""

    def __init__(self, config: LimitsConfig, now_s: Callable[[], float] = time.monotonic) -> None:
        self.level = DegradationLevel.FULL
        self.need: Need | None = None
        """Why the level is not FULL."""
        self.steps_down = 0
        self.steps_up = 0
        self._config, self._now_s = config, now_s
        self._updated_s = now_s()
        self._needed_s = now_s()

    @property
    def reason(self) -> str:
        """Why the level is not FULL, as a clause."""
        return "" if self.need is None else self.need.reason

    def update(self, need: Callable[[], Need | None]) -> None:
        """Every ``look_s``: ask ``need`` which resource runs short, if any does."""
        now = self._now_s()
        if now - self._updated_s < self._config.look_s:
            return
        self._updated_s = now
        short = need()
        if short is not None and self.level <= deepest(short):
            self.give_way(short)
        elif self.level > DegradationLevel.FULL and now - self._needed_s >= self._config.calm_s:
            self._needed_s = now
            self.steps_up += 1
            self._move(DegradationLevel(self.level - 1), "calm again")
            self.need = None if self.level is DegradationLevel.FULL else self.need

    def give_way(self, short: Need) -> None:
        """A step down at once, unless it would not help."""
        self._needed_s, self.need = self._now_s(), short
        if self.level < deepest(short):
            self.steps_down += 1
            self._move(DegradationLevel(self.level + 1), short.reason)

    def _move(self, level: DegradationLevel, why: str) -> None:
        log.warning("from '%s' to '%s': %s", self.level.words, level.words, why)
        self.level = level
