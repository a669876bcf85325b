"""How far the newest survey line overlaps the one before, and where the next one should lie."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.survey.coverage.survey_lines import SurveyLine

Array = npt.NDArray[np.float64]

SAMPLES_ALONG, SAMPLES_ACROSS = 40, 9
"""Places at which a strip is looked at."""
LEAST_GAIN = 0.1
"""Share of a strip that a next line must still find uncovered, or it is not worth swimming."""
FURTHEST = 2.0
"""Swaths up to which two lines are neighbours; one that is further away is of another survey."""
SAME_GAIN = 0.05
"""Difference of two shares below which the side of the survey so far decides."""

Covered = Callable[[Array], npt.NDArray[np.bool_]]
"""Of places [..., 2]: which are seen well, [...]."""


@dataclass(frozen=True)
class Suggestion:
    """The next survey line, from where it is nearest to the end of the last."""

    start: Array
    """[2] on the page."""
    end: Array
    """[2]"""
    gain: float
    """Share of its strip that is not seen well yet."""


@dataclass(frozen=True)
class LineState:
    """The newest line and what follows from it."""

    lines: list[SurveyLine]
    swath: float
    """Width that a picture shows across the path."""
    overlap: float | None
    """Share of the swath that the newest line has in common with the last parallel one beside it;
    negative: the gap between them, in swaths; None: there is none."""
    suggestion: Suggestion | None
    """None before the first line, and where everything beside it is seen well."""


def line_state(
    lines: list[SurveyLine],  # as from survey_lines
    swath: float,
    overlap: float,
    covered: Covered,
) -> LineState:
    """``overlap``: wanted, share of the swath."""
    if not lines or swath <= 0.0:
        return LineState(lines, swath, None, None)
    newest = lines[-1]
    before = _neighbour(newest, lines[:-1], swath)
    aside = None if before is None else newest.aside(0.5 * (before.start + before.end))
    found = None if aside is None else 1.0 - abs(aside) / swath
    suggestion = _suggest(newest, before, aside, swath, overlap, covered)
    return LineState(lines, swath, found, suggestion)


def _neighbour(line: SurveyLine, earlier: list[SurveyLine], swath: float) -> SurveyLine | None:
    """The last parallel line beside it."""
    for other in reversed(earlier):
        aside = abs(line.aside(0.5 * (other.start + other.end)))
        if line.is_parallel(other) and line.beside(other) and aside <= FURTHEST * swath:
            return other
    return None


def _suggest(
    newest: SurveyLine, before: SurveyLine | None, aside: float | None, swath: float,
    overlap: float,
    covered: Covered,
) -> Suggestion | None:  # fmt: skip
    if before is not None and aside is not None and abs(aside) > swath:
        # A strip between the two lines was missed; it is cheapest now.
        between = _strip(newest, 0.5 * aside, before, swath, covered)
        if between.gain >= LEAST_GAIN:
            return between
    spacing = swath * (1.0 - overlap)
    onwards = 1.0 if aside is None or aside <= 0.0 else -1.0
    sides = [_strip(newest, side * spacing, before, swath, covered) for side in (onwards, -onwards)]
    best = sides[1] if sides[1].gain > sides[0].gain + SAME_GAIN else sides[0]
    return best if best.gain >= LEAST_GAIN else None


def _strip(
    newest: SurveyLine, aside: float, before: SurveyLine | None, swath: float, covered: Covered
) -> Suggestion:
    """A line parallel to the newest, ``aside`` to its right, as long as that and the last one
    beside it, begun at the end where the vehicle is."""
    ends = [0.0, newest.length]
    if before is not None:
        ends += [float((p - newest.start) @ newest.direction) for p in (before.start, before.end)]
    low, high = min(ends), max(ends)
    offset = newest.start + aside * newest.right
    start, end = offset + high * newest.direction, offset + low * newest.direction
    along = np.linspace(low, high, SAMPLES_ALONG)[:, None, None] * newest.direction
    across = np.linspace(-0.5, 0.5, SAMPLES_ACROSS)[:, None] * swath * newest.right
    return Suggestion(start, end, 1.0 - float(covered(offset + along + across).mean()))
