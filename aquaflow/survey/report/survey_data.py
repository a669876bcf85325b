"""The report's values of a survey: depth and altitude over time, and what was left out."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.survey.report import LeftOut, Profile
from aquaflow.telemetry.metric_frame import MetricFrame

MOST_POINTS = 2000
"""Of a profile; a screen shows fewer."""
MOST_REASONS = 12
"""Lines of the table; what is rarer is one line."""
NUMBER = re.compile(r"\d+(\.\d+)?")
"""What makes one reason look like many."""


def profile(rows: Sequence[PoseRow], frame: MetricFrame) -> Profile | None:
    """Depth and altitude of the dive in metres; None where neither is known.

    Without a depth sensor the depth is that of the path, where the metric frame knows the surface.
    """
    chosen = [
        rows[i] for i in np.linspace(0, len(rows) - 1, min(len(rows), MOST_POINTS)).astype(int)
    ]
    depth = np.array([np.nan if row.depth_m is None else row.depth_m for row in chosen])
    altitude = np.array([np.nan if row.altitude_m is None else row.altitude_m for row in chosen])
    said = "depth below the surface"
    if not np.isfinite(depth).any() and frame.metric and frame.level:
        depth = np.array([row.z if row.unit == "m" else np.nan for row in chosen])
        said = "depth of the camera" if frame.depth_known else "camera, down from the dive's start"
    if not (np.isfinite(depth).any() or np.isfinite(altitude).any()):
        return None
    return Profile(np.array([row.t_s for row in chosen]), depth, altitude, said)


def left_out(rows: Iterable[FrameRow]) -> list[LeftOut]:
    """Frames without a pose, or of no use, by result and reason; the most frequent first."""
    counts = Counter(
        (row.frame_class, NUMBER.sub("N", row.reason.partition("\n")[0]).strip() or "not stated")
        for row in rows
        if row.frame_class in {"skipped", "lost", "dropped"}
    )
    listed = [LeftOut(kind, why, count) for (kind, why), count in counts.most_common(MOST_REASONS)]
    rest = sum(counts.values()) - sum(each.count for each in listed)
    return [*listed, LeftOut("all", "other reasons", rest)] if rest else listed
