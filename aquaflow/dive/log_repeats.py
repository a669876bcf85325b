"""Which entries of a log are written: repeats are counted, so that a fault of hours stays small."""

from __future__ import annotations

import re
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

WHOLE = 10
"""Entries of one kind that are all written: the history of a usual dive has no gaps."""
EVERY_S = 60.0
"""Of further ones, one is written so often: a link that comes and goes every second for an hour
takes 140 lines instead of 7200."""
KINDS = 1000
"""Kinds that are remembered; the one that was not met for longest is forgotten first."""
DIGITS = re.compile(r"\d+")
"""Texts that differ in their numbers are of one kind."""

Entry: TypeAlias = dict[str, Any]


@dataclass
class _Met:
    """What is known of one kind."""

    times: int = 0
    written_s: float = 0.0
    held: Entry = field(default_factory=dict)
    """The newest that was not written."""
    left_out: int = 0
    """Since the last that was written."""


class Repeats:
    """Decides for each entry; not thread-safe by itself."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._met: OrderedDict[tuple[str, ...], _Met] = OrderedDict()

    def admit(self, entry: Entry, *words: str) -> Entry | None:
        """The entry if it is to be written, with the count of those like it that were ``left_out``
        before; None if it is counted only. ``words``, such as its text, say what it is like."""
        kind, now_s = tuple(DIGITS.sub("#", word) for word in words), self._now_s()
        met = self._met.setdefault(kind, _Met())
        self._met.move_to_end(kind)
        if len(self._met) > KINDS:
            self._met.popitem(last=False)
        met.times += 1
        if met.times > WHOLE and now_s - met.written_s < EVERY_S:
            met.held, met.left_out = entry, met.left_out + 1
            return None
        left_out, met.written_s, met.left_out = met.left_out, now_s, 0
        return _counted(entry, left_out)

    def held(self) -> list[Entry]:
        """The newest of each kind that was not written, for the end of the log."""
        waiting = [met for met in self._met.values() if met.left_out]
        self._met.clear()
        return [_counted(met.held, met.left_out - 1) for met in waiting]


def _counted(entry: Entry, left_out: int) -> Entry:
    return {**entry, "left_out": left_out} if left_out else entry
