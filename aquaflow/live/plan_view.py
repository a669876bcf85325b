"""The path of a running dive, seen from above, for the page: bounded in points and in time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.dive.placement import names_of, page_axes
from aquaflow.dive.views import CoverageView
from aquaflow.geometry.similarity import Sim3
from aquaflow.live.dive_parts import Parts
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

MOST_POINTS = 500
"""Of a sub-map's path: more than a screen shows."""
KEPT_S = 1.0
"""Shortest time between two computations, whoever asks how often."""
DIGITS = 3
"""Decimals: millimetres."""

LEAST_LOOK = 0.1
"""Share of the viewing direction that must lie in the plane; a camera that looks straight down
looks to no side."""


class PlanView:
    """The path at the moment; asked from the threads of the health server."""

    def __init__(
        self,
        parts: Callable[[], Parts | None],
        now_s: Callable[[], float] = time.monotonic,
        coverage: CoverageView | None = None,
    ) -> None:
        """``parts``: of the dive that runs; None: there is none."""
        self._parts, self._now_s, self._coverage = parts, now_s, coverage
        self._lock = threading.Lock()
        self._computed_s = -KEPT_S
        self._said: dict[str, Any] = {}

    def to_json(self) -> dict[str, Any]:
        """``sub_maps``: of each its ``number``, ``unit``, from where it is ``seen``, what ``right``
        and ``up`` are on the page, and ``points`` [N, 2] through its keyframes. ``now``: the newest
        pose, its ``sub_map``, ``at`` [2], and ``ahead`` [2], a unit vector along the view's axis or
        null. With coverage, each sub-map has it as ``coverage``, and ``hints`` are those that hold.
        """
        with self._lock:
            if self._now_s() - self._computed_s >= KEPT_S:
                self._said = self._compute()
                self._computed_s = self._now_s()
            return self._said

    def _compute(self) -> dict[str, Any]:
        parts = self._parts()
        if parts is None:
            return {"sub_maps": [], "now": None}
        slam, latest = parts.slam, parts.loop.latest
        centres: dict[int, list[Array]] = {}
        for keyframe in list(slam.keyframes.keyframes):  # tracking appends to it meanwhile
            centres.setdefault(keyframe.sub_map, []).append(keyframe.T_wc.t)
        plans = {
            number: _SubMapPlan(slam.metric_frame(number), _thin(own))
            for number, own in sorted(centres.items())
        }
        now = None
        if latest is not None and latest.T_wc is not None and latest.sub_map in plans:
            now = {"sub_map": latest.sub_map, **plans[latest.sub_map].pose(latest.T_wc)}
        sub_maps = [{"number": number, **plan.to_json()} for number, plan in plans.items()]
        if self._coverage is None:
            return {"sub_maps": sub_maps, "now": now}
        seen = self._coverage.to_json()
        sub_maps = [each | {"coverage": seen.get(each["number"])} for each in sub_maps]
        return {"sub_maps": sub_maps, "now": now, "hints": self._coverage.in_words()}


class _SubMapPlan:
    """One sub-map's path, and the plane that it is shown in."""

    def __init__(
        self,
        frame: WorldFrame,
        centres: Array,  # [N, 3] in the sub-map's world
    ) -> None:
        self._frame = frame
        self._path = frame.T_nm.apply(centres)
        self._axes = page_axes(frame, self._path)

    def to_json(self) -> dict[str, Any]:
        seen, right, up = names_of(self._frame, self._axes)
        points = np.round(self._path @ self._axes.T, DIGITS).tolist()
        return {
            "unit": self._frame.unit, "seen": seen, "right": right, "up": up, "points": points,
        }  # fmt: skip

    def pose(self, T_mc: Sim3) -> dict[str, Any]:
        """Pose of the camera."""
        T_nc = self._frame.pose(T_mc)
        ahead = self._axes @ T_nc.R[:, 2]
        length = float(np.linalg.norm(ahead))
        known = length >= LEAST_LOOK
        return {
            "at": np.round(self._axes @ T_nc.t, DIGITS).tolist(),
            "ahead": np.round(ahead / length, DIGITS).tolist() if known else None,
        }


def _thin(
    centres: list[Array],  # each [3]
) -> Array:
    """[N, 3] at most MOST_POINTS of them, the first and the last among them."""
    count = min(len(centres), MOST_POINTS)
    chosen = np.linspace(0, len(centres) - 1, count).round().astype(int)
    return np.array([centres[i] for i in chosen])
