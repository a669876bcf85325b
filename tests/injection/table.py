"""The injection table: calls found, calls injected, dives that ended whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

WHOLE, REFUSED, OWN_WAY = "whole", "refused at the start", "stopped its own way"
NOT_MET, BROKEN = "not met", "broken"
OUTCOMES = (WHOLE, REFUSED, OWN_WAY, NOT_MET, BROKEN)
"""Refused: before the first frame, in one sentence. Its own way: interrupts, full memory and full
disks end a dive in one sentence too, and keep what was recorded. Not met: the dive, which differs
each time, never came to that call."""


@dataclass(frozen=True)
class Result:
    """What came of one fault."""

    dive: str
    command: str
    library: str
    site: str
    kind: str
    call: int
    phase: str
    outcome: str
    problems: list[str]
    cpu_s: float

    def line(self) -> str:
        """One line for whoever mends it."""
        said = "; ".join(self.problems)
        return f"{self.dive} [{self.kind}] {self.site} #{self.call} ({self.phase}): {said}"


def table(found: Counter[tuple[str, str]], results: Sequence[Result]) -> str:
    """A row for each command, library and kind; ``found`` counts sites by command and library."""
    head = ("command", "library", "kind", "sites found", "injected", *OUTCOMES)
    rows: list[tuple[Any, ...]] = []
    for key in sorted({(r.command, r.library, r.kind) for r in results}):
        those = [r for r in results if (r.command, r.library, r.kind) == key]
        counts = Counter(r.outcome for r in those)
        rows.append((*key, found[key[0], key[1]], len(those), *(counts[o] for o in OUTCOMES)))
    counts = Counter(r.outcome for r in results)
    total = ("total", "", "", found.total(), len(results), *(counts[o] for o in OUTCOMES))
    return "\n".join(_aligned([head, *rows, total]))


def _aligned(rows: list[tuple[Any, ...]]) -> list[str]:
    widths = [max(len(str(row[i])) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(
            str(cell).ljust(width) if i < 3 else str(cell).rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
