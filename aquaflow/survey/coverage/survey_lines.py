"""Survey lines in a path from above: straight stretches, and the turns between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

OFF_LINE = 0.2
"""Swaths by which a path may leave a straight line and still be on it: half of what 60 % overlap
can spare."""
LEAST_LENGTH = 1.5
"""Swaths; a shorter straight stretch is part of a turn, or of the way from one line to the next,
which at 60 % overlap is 0.4 swaths long, and at none a whole one."""
PARALLEL_RAD = float(np.radians(20.0))
"""Largest angle between two lines that count as parallel, whichever way each was swum."""
SPACING = 0.1
"""Swaths between the points of a path that are looked at: a survey of an hour has thousands."""
MOST_POINTS = 2000
"""Newest points that are looked at: at 2 m of swath the last 400 m, some ten lines."""


@dataclass(frozen=True)
class SurveyLine:
    """A straight stretch of the path."""

    start: Array
    """[2] on the page."""
    end: Array
    """[2]; where it was left, or the newest place."""
    first: int
    last: int
    """Points of the path, the last one included."""

    @property
    def length(self) -> float:
        """Length from start to end."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def direction(self) -> Array:
        """[2] unit vector along it."""
        return (self.end - self.start) / self.length

    @property
    def right(self) -> Array:
        """[2] unit vector to the right of it."""
        x, y = self.direction
        return np.array([y, -x])

    def is_parallel(self, other: SurveyLine) -> bool:
        """True also if the other was swum the other way."""
        return bool(abs(self.direction @ other.direction) >= np.cos(PARALLEL_RAD))

    def beside(self, other: SurveyLine) -> bool:
        """True if a part of the other lies beside this one."""
        along = [float((point - self.start) @ self.direction) for point in (other.start, other.end)]
        return max(along) > 0.0 and min(along) < self.length

    def aside(
        self,
        point: Array,  # [2]
    ) -> float:
        """How far a point lies to the right of the line."""
        return float((point - self.start) @ self.right)


def survey_lines(
    path: Array,  # [N, 2] camera centres on the page, in time
    swath: float,
    alone: float | None = None,
) -> list[SurveyLine]:
    """The straight stretches, the earliest first; ``swath``: width that a picture shows.

    A path without any turn is no way between two lines: it is one from the length ``alone`` on, if
    that is given. Of eight stills of an AUV, whole lines are 1.2 to 1.5 swaths long.
    """
    kept = _thin(path, SPACING * swath)
    if len(kept) < 2:
        return []
    points = path[kept]
    corners = _corners(points, OFF_LINE * swath)
    lines, least = [], LEAST_LENGTH * swath
    if alone is not None and len(corners) == 2:
        least = min(least, alone)
    for first, last in pairwise(corners):
        start, end = _fit(points[first : last + 1])
        if float(np.linalg.norm(end - start)) >= least:
            lines.append(SurveyLine(start, end, int(kept[first]), int(kept[last])))
    return lines


def _thin(
    path: Array,  # [N, 2]
    spacing: float,
) -> npt.NDArray[np.intp]:
    """Numbers of points that are at least so far apart, newest first chosen; in time."""
    if len(path) == 0:
        return np.zeros(0, np.intp)
    chosen = [len(path) - 1]
    for number in range(len(path) - 2, -1, -1):
        if np.hypot(*(path[number] - path[chosen[-1]])) >= spacing:
            chosen.append(number)
            if len(chosen) == MOST_POINTS:
                break
    return np.array(chosen[::-1])


def _corners(
    points: Array,  # [N, 2]
    off: float,
) -> list[int]:
    """Numbers of the points where a polygon that is nowhere further ``off`` the path has its
    corners, ends included (Douglas and Peucker, Cartographica 10, 1973)."""
    corners, waiting = {0, len(points) - 1}, [(0, len(points) - 1)]
    while waiting:
        first, last = waiting.pop()
        if last - first < 2:
            continue
        inner, chord = points[first + 1 : last] - points[first], points[last] - points[first]
        length = float(np.hypot(*chord))
        if length > 0.0:
            along = np.clip(inner @ chord / length**2, 0.0, 1.0)
            inner = inner - along[:, None] * chord
        distances = np.hypot(*inner.T)
        worst = int(distances.argmax())
        if distances[worst] > off:
            middle = first + 1 + worst
            corners.add(middle)
            waiting += [(first, middle), (middle, last)]
    return sorted(corners)


def _fit(
    points: Array,  # [N, 2]
) -> tuple[Array, Array]:
    """The ends of the straight line of least squares through points, seen from the outer two."""
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    along = (points[[0, -1]] - middle) @ axes[0]
    return middle + along[0] * axes[0], middle + along[1] * axes[0]


# --------------------------------------------------------------------------------------------------
# How far the newest survey line overlaps the one before, and where the next one should lie.

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
