"""How far a command is, and how long it still takes, in the same words everywhere."""

from __future__ import annotations

import time
from collections.abc import Callable

Progress = Callable[[str, int, int | None], None]
"""Called with the stage, the steps done and, where known, the steps there are."""
WHOLE = "whole"
"""Stage that counts the seconds of all others, of which it estimates the number."""


class Course:
    """The stage of a command, its steps, and the time left: of ``WHOLE`` if the command knows it,
    else of the stage."""

    def __init__(self) -> None:
        self.stage = ""
        self._done, self._total = 0, 0
        self._begun, self._begun_s = 0, 0.0
        self._ends_s: float | None = None
        self._knows_whole = False

    def advance(self, stage: str, done: int, total: int | None) -> None:
        """``done`` of the steps of a stage are done."""
        now_s = time.monotonic()
        if stage == WHOLE:
            self._knows_whole, self._ends_s = True, now_s + (total or done) - done
            return
        if stage != self.stage:
            self.stage, self._begun, self._begun_s = stage, done, now_s
        self._done, self._total = done, total or 0
        if not self._knows_whole:
            paced = self._total > 0 and done > self._begun
            step_s = (now_s - self._begun_s) / max(done - self._begun, 1)
            self._ends_s = now_s + step_s * (self._total - done) if paced else None

    def left(self) -> str:
        """The time left, in words; empty while it is unknown."""
        if self._ends_s is None:
            return ""
        left_s = max(self._ends_s - time.monotonic(), 0.0)
        hours, minutes = divmod(round(left_s / 60.0), 60)
        if not hours + minutes:
            return "less than a minute left"
        return f"about {f'{hours} h ' if hours else ''}{minutes} min left"

    def steps(self) -> str:
        """The steps of the stage, and the time left, in words."""
        of = f" of {self._total}" if self._total else ""
        return "; ".join(filter(None, [f"{self._done}{of}", self.left()]))

    def in_words(self) -> str:
        """One line."""
        return f"{self.stage}: {self.steps()}"
