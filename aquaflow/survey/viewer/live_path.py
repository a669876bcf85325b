"""The path of a running dive, as the viewer shows it: poses with their moments."""

from __future__ import annotations

import math
from collections.abc import Iterable
from datetime import datetime, timedelta
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from aquaflow.dive.path_rows import attitude_of
from aquaflow.survey.viewer.exhibit import POSE_NUMBERS
from aquaflow.survey.viewer.moments import moments
from aquaflow.telemetry.metric_frame import MetricFrame
from aquaflow.tracking.frames import Tracked

LONGEST_PATH = 5000
"""Most poses of the path that are shown; a longer one is thinned."""
OLD_S = 3.0
"""A depth that was measured so long ago is not the pose's."""
Rows = npt.NDArray[np.float32]


class _Row(NamedTuple):
    pose: tuple[float, ...]
    frame: int
    t_s: float
    depth_m: float
    heading_deg: float


class LivePath:
    """Tracking's thread adds poses; the viewer's thread says what the vehicle measures."""

    def __init__(self) -> None:
        self.began: datetime | None = None
        """UTC of the first pose, once a source of telemetry stated the time."""
        self._rows: list[_Row] = []
        self._depth_m = math.nan

    def add(self, tracked: Tracked, frame: MetricFrame) -> None:
        """A posed frame, in the metric ``frame`` of its sub-map as it is known by now."""
        T_wc = tracked.T_wc
        assert T_wc is not None
        pose = (*T_wc.t.tolist(), *T_wc.quaternion.tolist(), tracked.quality.inlier_share)
        heading, _, _ = attitude_of(frame, frame.pose(T_wc))
        turned = math.nan if heading is None else heading
        at = tracked.frame
        self._rows.append(_Row(pose, at.index, 1e-9 * at.t_ns, self._depth_m, turned))
        if len(self._rows) > LONGEST_PATH:
            self._rows = self._rows[::2]

    def hear(self, telemetry: dict[str, dict[str, dict[str, Any]]]) -> None:
        """The newest values by source and kind, as /health has them."""
        kinds = {kind: said for each in telemetry.values() for kind, said in each.items()}
        depth, utc = kinds.get("depth"), kinds.get("utc_time")
        known = depth is not None and depth["age_s"] <= OLD_S
        self._depth_m = float(depth["value"]) if known and depth is not None else math.nan
        rows = self._rows
        if utc is not None and self.began is None and rows:
            now = datetime.fromisoformat(utc["value"].replace("Z", "+00:00"))
            ago_s = rows[-1].t_s - rows[0].t_s - float(utc["age_s"])
            self.began = now - timedelta(seconds=ago_s)

    def rows(self, kept: Iterable[int]) -> tuple[Rows, Rows]:
        """Poses [N, 8] and moments [N, 5]; ``kept``: frames whose picture is there."""
        rows = self._rows
        poses = np.array([row.pose for row in rows], np.float32).reshape(-1, POSE_NUMBERS)
        t_s, depth, heading = np.array([row[2:] for row in rows], np.float64).reshape(-1, 3).T
        index = np.array([row.frame for row in rows], np.int64)
        return poses, moments(t_s, depth, heading, index, kept)
