"""Which samples the estimator can use of a dive's telemetry, and why not the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.telemetry import Series, Telemetry
from aquaflow.telemetry.world_frame import SourceReport
from aquaflow.types import KINDS

LEAST_SAMPLES = 5
"""Of one source while the camera had poses; fewer cannot show their noise."""
LEAST_FIXES = 3
"""Of positions, each of which states its own sigma; two would agree with any scale and heading."""
USED = ("depth", "attitude", "acceleration", "velocity", "altitude", "position")
"""Kinds of message that say something about the map's frame."""


@dataclass(frozen=True)
class UsableSeries:
    """The samples of each kind at moments when the camera had a pose."""

    depth: list[Series] = field(default_factory=list)
    attitude: list[Series] = field(default_factory=list)
    acceleration: list[Series] = field(default_factory=list)
    velocity: list[Series] = field(default_factory=list)
    altitude: list[Series] = field(default_factory=list)
    position: list[Series] = field(default_factory=list)
    left_out: list[SourceReport] = field(default_factory=list)

    @staticmethod
    def of(
        telemetry: Telemetry, path: CameraPath, rejected: Mapping[tuple[str, str], SourceReport]
    ) -> UsableSeries:
        """All sources with enough samples along the path that are not ``rejected``, which are
        given by source and kind."""
        usable = UsableSeries(left_out=list(rejected.values()))
        for kind in USED:
            for series in telemetry.of(KINDS[kind]):
                if (series.source, kind) in rejected:
                    continue
                covered = path.covers(series.t_s)
                least = LEAST_FIXES if kind == "position" else LEAST_SAMPLES
                if int(covered.sum()) < least:
                    reason = _why_not(series, path, least)
                    usable.left_out.append(SourceReport(series.source, kind, reason=reason))
                    continue
                chosen = Series(series.source, series.t_s[covered], series.values[covered])
                getattr(usable, kind).append(chosen)
        return usable


def _why_not(series: Series, path: CameraPath, least: int) -> str:
    if len(series) < least:
        return f"only {len(series)} samples"
    first, last = float(np.min(series.t_s)), float(np.max(series.t_s))
    if last < path.t_s[0] or first > path.t_s[-1]:
        return (
            f"its samples are of {first:.0f} to {last:.0f} s, the camera's poses of "
            f"{path.t_s[0]:.0f} to {path.t_s[-1]:.0f} s"
        )
    return "too few samples while the camera had a pose"
