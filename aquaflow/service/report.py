"""The report of a running service as one object, for /health, /metrics and `status`."""

from __future__ import annotations

import resource
import time
from dataclasses import asdict
from typing import Any

from aquaflow import __version__
from aquaflow.service.health.state import State
from aquaflow.service.health.telemetry import metric_frame_numbers, newest_values
from aquaflow.service.live_dive import Parts
from aquaflow.service.vehicle.pose_output import PoseOutput

GOOD = (State.TRACKING, State.INITIALISING)
"""States that need no action."""
CHANGES_LISTED = 10
"""Latest changes of state that the report lists."""


def report(
    parts: Parts, hang_s: float, poses: PoseOutput | None = None, now_s: float | None = None
) -> dict[str, Any]:
    """The report, with stable keys; may be called from any thread."""
    loop, now = parts.loop, time.monotonic() if now_s is None else now_s
    health, hung = loop.health, loop.heartbeats.hung(hang_s)
    return {
        "version": __version__,
        "state": health.state.value,
        "reason": health.reason,
        "ok": health.state in GOOD and hung is None,
        "hung_stage": hung,
        "since_s": round(now - health.since_s, 1),
        "changes": [
            {
                "ago_s": round(now - change.t_s, 1),
                "before": change.before.value,
                "after": change.after.value,
                "reason": change.reason,
            }
            for change in list(health.changes)[-CHANGES_LISTED:]
        ],
        "dive": parts.choice.folder.name,
        "resumed": parts.choice.checkpoint is not None,
        **loop.status(),
        "keyframes": len(parts.slam.keyframes),
        "consistency": parts.slam.tracker.monitor.counts.to_json(),
        "gaussians": sum(len(mapper.gaussians) for mapper in list(parts.maps.mappers.values())),
        "checkpoint": {
            "taken": parts.checkpointer.taken,
            "failures": parts.checkpointer.failures,
            "bytes": parts.checkpointer.size_bytes,
            "seconds": round(parts.checkpointer.wrote_s, 3),
        },
        "machine": asdict(loop.pressure) | {"peak_rss_mb": _peak_rss_mb()},
        "devices": loop.feed.describe(),
        "telemetry_samples": loop.feed.latest_samples.samples,
        "telemetry": newest_values(loop.feed.latest_samples.latest()),
        "metric_frame": metric_frame_numbers(parts.slam.metric_frame(parts.slam.tracker.sub_map)),
        "pose_output": None if poses is None else poses.to_json(),
    }


def _peak_rss_mb() -> float:
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)
