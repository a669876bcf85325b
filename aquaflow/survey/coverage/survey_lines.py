"""Survey lines in a path from above: straight stretches, and the turns between them."""

from __future__ import annotations

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
        """From start to end."""
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
