"""Where a survey's vehicle goes, and what is between it and the seabed on the way.

Two plans: lines side by side without end, and a long dive of three areas with transits, revisits
and events. Both say all of any moment alone, so that nobody has to hold a dive of an hour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
SurveyScene: TypeAlias = Literal["lines", "hour"]

SPEED_M_S = 0.5
"""A usual speed of a survey."""
LINE_M, BETWEEN_LINES_M = 12.0, 0.7
"""Length of a line (240 pictures), and the way to the next one: half of the picture's height."""
HOUR_S = 3600.0
AREA_LINES = 33
"""Lines of each of the three areas in an hour: 14 minutes, 12 by 22 m."""
GAP_M = (3.0, 15.0)
"""Between two areas, m: of any dive, and what is added in an hour; a picture is 1.9 m wide."""
CROSSINGS_M = (3.0, 6.0, 9.0)
"""Along a line: where an area is crossed on its revisit."""
NOTHING_S = 20.0
"""In which the camera sees nothing, in the middle of two of the transits."""
RAMP_S = 1.0
"""In which a cloud, a veil or darkness comes and goes."""
SILT_S = 6.0
"""That a cloud of silt is in front of the camera."""
SILT_AT = (0.05, 0.2, 0.36, 0.56, 0.78, 0.92)
"""Shares of the dive at which one comes."""
TURBID_AT = ((0.09, 0.12), (0.68, 0.72))
"""Shares of the dive between which the water is ``TURBIDITY`` times as dense."""
TURBIDITY = 2.0
"""Coastal water of type 1C becomes like 5C."""
LAMP_FAILS_AT = 0.45
"""Share of the dive from which the left lamp is dark."""
FLICKER_S, FLICKER_HZ = 2.0, 2.0
"""Before it fails."""


@dataclass(frozen=True)
class Conditions:
    """What is between lamps, seabed and camera at one moment."""

    turbidity: float = 1.0
    """Attenuation, and growth of the backscatter, over those of the water."""
    lamps: tuple[float, float] | None = None
    """Levels of the left and the right one, 0 to 1; None: daylight alone."""
    silt: float = 0.0
    """Density of a cloud close to the camera, 0 to 1."""
    veil: float = 0.0
    """Share of the picture's light that is that of open water."""
    light: float = 1.0
    """Of daylight and lamps, over what there is."""


class SurveyPlan(Protocol):
    """What pictures and instruments need to know of a dive."""

    def place(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 2] m, of the vehicle over the seabed, without its sway."""
        ...

    def velocity(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 2] m/s, of the same."""
        ...

    def conditions(self, t: float) -> Conditions:
        """At ``t`` s."""
        ...


@dataclass(frozen=True)
class EndlessLines:
    """Up and down over lines that overlap, as a mower goes: the area grows with the time."""

    def place(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 2] m."""
        line, along, on_line = self._of(t)
        x = np.where(on_line, along, LINE_M)
        x = np.where(line % 2 == 1, LINE_M - x, x)
        return np.stack([x, line * BETWEEN_LINES_M + np.maximum(along - LINE_M, 0.0)], axis=-1)

    def velocity(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 2] m/s."""
        line, _, on_line = self._of(t)
        forth = np.where(line % 2 == 1, -SPEED_M_S, SPEED_M_S)
        return np.stack([np.where(on_line, forth, 0.0), np.where(on_line, 0.0, SPEED_M_S)], axis=-1)

    def conditions(self, t: float) -> Conditions:
        """Daylight in even water."""
        return Conditions()

    @staticmethod
    def _of(
        t: Array,  # [N] s
    ) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """[N] each: number of the line, m from its start, and whether that is on it."""
        line, along = np.divmod(t * SPEED_M_S, LINE_M + BETWEEN_LINES_M)
        return line, along, along < LINE_M


@dataclass(frozen=True)
class LongDive:
    """Areas A, B and C, and A crossed and flown again: an hour, or less of the same.

    A is mapped first, then B; after half of the dive A is crossed, so that loops are closed with
    what was seen half an hour before. C follows, and the rest of the dive goes over A's lines once
    more. Between areas lie transits; for 20 s of the first and of the third nothing is seen, once
    in blue water and once in the dark, so that tracking has to begin again.
    """

    duration_s: float = HOUR_S
    waypoints: Array = field(init=False, repr=False)
    """[W, 2] m"""
    dark_s: tuple[float, float] = field(init=False)
    """Middles of the two times of nothing, s: of blue water, and of darkness."""

    def __post_init__(self) -> None:
        share = self.duration_s / HOUR_S
        lines = max(2, round(AREA_LINES * share))
        aside = LINE_M + GAP_M[0] + GAP_M[1] * share
        top = (lines - 1) * BETWEEN_LINES_M
        first, second, third = (_lines(x, lines) for x in (0.0, aside, -aside))
        crossings = [
            (x, y)
            for number, x in enumerate(CROSSINGS_M)
            for y in ((0.0, top) if number % 2 == 0 else (top, 0.0))
        ]
        again = _lines(0.0, 10 * lines)  # more than there is time for
        parts = [first, second, crossings, third, again]
        waypoints = np.array([point for part in parts for point in part])
        object.__setattr__(self, "waypoints", waypoints)
        ends = np.cumsum([len(part) for part in parts])
        middles = [(self._reached_s[n - 1] + self._reached_s[n]) / 2.0 for n in (ends[0], ends[2])]
        object.__setattr__(self, "dark_s", (float(middles[0]), float(middles[1])))

    @cached_property
    def _reached_s(self) -> Array:
        """[W] s at which each waypoint is reached."""
        lengths = np.linalg.norm(np.diff(self.waypoints, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(lengths)]) / SPEED_M_S

    def place(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 2] m."""
        columns = [np.interp(t, self._reached_s, column) for column in self.waypoints.T]
        return np.stack(columns, axis=-1)

    def velocity(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 2] m/s."""
        leg = np.searchsorted(self._reached_s, t, side="right").clip(1, len(self.waypoints) - 1)
        way = self.waypoints[leg] - self.waypoints[leg - 1]
        return np.asarray(SPEED_M_S * way / np.linalg.norm(way, axis=-1, keepdims=True))

    def conditions(self, t: float) -> Conditions:
        """At ``t`` s of the dive."""
        blue, black = (
            _ramp(t, middle - NOTHING_S / 2.0, middle + NOTHING_S / 2.0) for middle in self.dark_s
        )
        turbid = max(self._within(t, begin, end) for begin, end in TURBID_AT)
        silt = max(
            _ramp(t, share * self.duration_s, share * self.duration_s + SILT_S)
            for share in SILT_AT
        )  # fmt: skip
        left = self._left_lamp(t)
        return Conditions(1.0 + (TURBIDITY - 1.0) * turbid, (left, 1.0), silt, blue, 1.0 - black)

    def _within(self, t: float, begin: float, end: float) -> float:
        return _ramp(t, begin * self.duration_s, end * self.duration_s)

    def _left_lamp(self, t: float) -> float:
        failing = t - LAMP_FAILS_AT * self.duration_s
        if failing < 0.0:
            return 1.0
        return float(failing < FLICKER_S and failing * FLICKER_HZ % 1.0 > 0.5)


def plan_of(scene: SurveyScene, duration_s: float) -> SurveyPlan:
    """The plan of a dive of ``duration_s``."""
    return LongDive(duration_s) if scene == "hour" else EndlessLines()


def _lines(x: float, count: int) -> Sequence[tuple[float, float]]:
    """The ends of lines that begin at ``x``, 0."""
    ends = [(x, x + LINE_M), (x + LINE_M, x)]
    return [(end, number * BETWEEN_LINES_M) for number in range(count) for end in ends[number % 2]]


def _ramp(t: float, begin: float, end: float) -> float:
    """1 from ``begin`` to ``end``, 0 far from there."""
    return float(np.clip(min(t - begin, end - t) / RAMP_S + 1.0, 0.0, 1.0))
