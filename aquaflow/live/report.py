"""The report of a running service as one object, for /health, /metrics and `run status`."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime, timezone
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow import __version__
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.metric_outputs import metric_frame_numbers
from aquaflow.dive.placement import in_site_numbers
from aquaflow.live.control import ServiceControl
from aquaflow.live.dive_parts import Parts
from aquaflow.live.feed import Feed
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.state import ServiceState
from aquaflow.live.idle_loop import IdleLoop
from aquaflow.live.vehicle.pose_output import PoseOutput
from aquaflow.types import KIND_OF, VALUES, Attitude, Position, TelemetrySample, UtcTime

GOOD = (
    ServiceState.TRACKING,
    ServiceState.INITIALISING,
    ServiceState.IDLE,
    ServiceState.PAUSED,
    ServiceState.FINISHING,
)
"""States that need no action."""
CHANGES_LISTED = 10
"""Latest changes of state that the report lists."""


def report(
    parts: Parts, hang_s: float, poses: PoseOutput | None = None, now_s: float | None = None
) -> dict[str, Any]:
    """The report, with stable keys; may be called from any thread."""
    loop, folder = parts.loop, parts.choice.folder
    return {
        **_state(loop.vitals, hang_s, now_s),
        "dive": {
            "state": loop.control.phase.value,
            "name": folder.name,
            "folder": str(folder),
            "begun_utc": parts.standing.status.begun_utc,
            "frames": parts.frames_before + loop.counters.frames,
        },
        "resumed": parts.choice.checkpoint is not None,
        **loop.status(),
        "keyframes": len(parts.slam.keyframes),
        "consistency": parts.slam.tracker.monitor.counts.to_json(),
        "in_site": None
        if parts.slam.in_base is None
        else in_site_numbers(parts.slam.in_base, parts.maps.taken_over),
        "gaussians": sum(mapper.count for mapper in list(parts.maps.mappers.values())),
        "checkpoint": {
            "taken": parts.checkpointer.taken,
            "failures": parts.checkpointer.failures,
            "bytes": parts.checkpointer.size_bytes,
            "seconds": round(parts.checkpointer.wrote_s, 3),
        },
        "deliverables": parts.refresher.to_json(),
        "machine": asdict(loop.pressure) | {"peak_rss_mb": _peak_rss_mb()},
        **_devices(loop.feed),
        "calibration_check": parts.loop.dive_run.calibration_numbers,
        "metric_frame": metric_frame_numbers(parts.slam.metric_frame(parts.slam.tracker.sub_map)),
        "pose_output": None if poses is None else poses.to_json(),
    }


def report_between_dives(
    standby: IdleLoop, control: ServiceControl, feed: Feed, now_s: float | None = None
) -> dict[str, Any]:
    """The same keys while there is no dive: its numbers are 0, or null."""
    vitals = standby.vitals
    return {
        **_state(vitals, vitals.hang_s, now_s),
        "dive": {
            "state": control.phase.value, "name": None, "folder": None, "begun_utc": None,
            "frames": 0,
        },
        "resumed": False,
        **standby.counters.to_json(),
        **dict.fromkeys(("overtaken", "steps_down", "steps_up"), 0),
        "level": vitals.degradation.level.words,
        "visits": {state.value: count for state, count in vitals.health.visits.items()},
        "left_out_of_the_map": {},
        **dict.fromkeys(
            ("mapped_without_steps", "mapping_failures", "mapping_waits", "mapping_rests"), 0
        ),
        "stage_failures": feed.failures.to_json(),
        "keyframes": 0,
        "consistency": None,
        "in_site": None,
        "gaussians": 0,
        "checkpoint": None,
        "deliverables": None,
        "machine": {"peak_rss_mb": _peak_rss_mb()},
        **_devices(feed),
        "calibration_check": None,
        "metric_frame": None,
        "pose_output": None,
    }  # fmt: skip


def _state(vitals: ServiceHealth, hang_s: float, now_s: float | None) -> dict[str, Any]:
    now = time.monotonic() if now_s is None else now_s
    health, hung = vitals.health, vitals.heartbeats.find_hung_stage(hang_s)
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
    }


def _devices(feed: Feed) -> dict[str, Any]:
    return {
        "devices": feed.describe(),
        "telemetry_samples": feed.latest_samples.samples,
        "telemetry": newest_values(feed.latest_samples.latest()),
    }


def viewer_facts(config: ViewerConfig) -> dict[str, Any] | None:
    """Where the viewer listens, for the page's link to it; None if it does not."""
    return {"host": config.host, "port": config.port} if config.enabled else None


def _peak_rss_mb() -> float:
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


# --------------------------------------------------------------------------------------------------
# What every source of telemetry measures now.

UNITS = {
    "depth": "m",
    "attitude": "deg roll, pitch, heading",
    "angular_rate": "rad/s",
    "acceleration": "m/s^2",
    "velocity": "m/s",
    "altitude": "m",
    "lights": "of 1",
    "position": "deg latitude, longitude",
    "utc_time": "UTC",
}
"""Unit of the value of each kind of sample."""
DIGITS, PLACE_DIGITS = 3, 7
"""Decimals shown; a degree of latitude has 111 km."""


def newest_values(
    latest: Iterable[tuple[TelemetrySample, float]],
) -> dict[str, dict[str, dict[str, Any]]]:
    """By source and kind: ``value`` (a number, a list or a text), ``unit`` and ``age_s``.

    ``latest``: the newest sample of each source and kind, and the seconds since it came.
    """
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for sample, age_s in sorted(latest, key=lambda each: each[0].source):
        kind = KIND_OF[type(sample)]
        said = {"value": _value(sample), "unit": UNITS[kind], "age_s": round(age_s, 1)}
        found.setdefault(sample.source, {})[kind] = said
    return found


def _value(sample: TelemetrySample) -> float | list[float] | str:
    if isinstance(sample, UtcTime):
        moment = datetime.fromtimestamp(sample.utc_ns * 1e-9, timezone.utc)
        return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if isinstance(sample, Attitude):
        R = Rotation.from_quat(np.roll(sample.wxyz, -1))
        yaw, pitch, roll = R.as_euler("ZYX", degrees=True)
        return [round(float(angle), DIGITS) for angle in (roll, pitch, yaw % 360.0)]
    if isinstance(sample, Position):
        return [round(each, PLACE_DIGITS) for each in (sample.latitude_deg, sample.longitude_deg)]
    value = getattr(sample, VALUES[type(sample)][0])
    if isinstance(value, tuple):
        return [round(each, DIGITS) for each in value]
    return round(float(value), DIGITS)
