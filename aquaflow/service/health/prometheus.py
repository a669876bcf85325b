"""The report as Prometheus reads it (text format 0.0.4)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from aquaflow.service.health.state import State

TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Content type of Prometheus' text format."""

COUNTERS = {
    "frames": "Frames that were looked at.",
    "failures": "Frames that raised, each costing itself.",
    "overtaken": "Frames that a newer one overtook.",
    "mapping_failures": "Requests to the map that raised.",
    "steps_down": "Steps down to a lower degradation level.",
    "steps_up": "Steps back up.",
    "telemetry_samples": "Telemetry samples received.",
}
"""Metrics that only grow: name and help."""
GAUGES = {
    "fps": "Frames per second, lately.",
    "mapping_waits": "Requests that wait for mapping.",
    "keyframes": "Keyframes of the dive.",
    "gaussians": "Gaussians of all maps.",
}
"""Metrics that rise and fall: name and help."""


def exposition(report: Mapping[str, Any]) -> str:
    """The metrics of one report."""
    return "".join(f"{line}\n" for line in _lines(report))


def _lines(report: Mapping[str, Any]) -> Iterator[str]:
    yield from _head("state", "gauge", "1 for the state that the service is in.")
    for state in State:
        yield f'aquaflow_state{{state="{state.value}"}} {int(report["state"] == state.value)}'
    yield from _head("ok", "gauge", "1 while nothing is to be done about it.")
    yield f"aquaflow_ok {int(report['ok'])}"
    for name, help_text in COUNTERS.items():
        yield from _head(f"{name}_total", "counter", help_text)
        yield f"aquaflow_{name}_total {report[name]}"
    for name, help_text in GAUGES.items():
        yield from _head(name, "gauge", help_text)
        yield f"aquaflow_{name} {report[name]}"
    yield from _head("lag_seconds", "gauge", "From a frame's arrival to its pose, last minute.")
    for key, quantile in (("p50", "0.5"), ("p95", "0.95")):
        lag = report["lag_ms"][key]
        if lag is not None:
            yield f'aquaflow_lag_seconds{{quantile="{quantile}"}} {lag / 1e3:g}'
    yield from _labelled("frames_by_class_total", "class", report["classes"], "Frames by result.")
    yield from _labelled(
        "left_out_total", "reason", report["left_out_of_the_map"], "Frames that the map never saw."
    )
    yield from _labelled("state_visits_total", "state", report["visits"], "Times in each state.")
    yield from _head("stage_failures_total", "counter", "Failures of a stage, by exception.")
    for kind in report["stage_failures"]:
        labels = f'stage="{_escaped(kind["stage"])}",error="{_escaped(kind["error"])}"'
        labels += f',place="{_escaped(kind["place"])}"'
        yield f"aquaflow_stage_failures_total{{{labels}}} {kind['count']}"
    poses = report["pose_output"]
    if poses is not None:
        yield from _head("poses_sent_total", "counter", "Poses sent to the autopilot.")
        yield f"aquaflow_poses_sent_total {poses['sent']}"
        yield from _labelled(
            "poses_withheld_total", "reason", poses["withheld"], "Poses not sent to the autopilot."
        )
    yield from _labelled(
        "stage_share", "stage", report["stage_shares"], "Seconds per second in a stage.", "gauge"
    )


def _labelled(
    name: str, label: str, values: Mapping[str, float], help_text: str, kind: str = "counter"
) -> Iterator[str]:
    yield from _head(name, kind, help_text)
    for value, number in values.items():
        yield f'aquaflow_{name}{{{label}="{_escaped(value)}"}} {number}'


def _escaped(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", " ")


def _head(name: str, kind: str, help_text: str) -> Iterator[str]:
    yield f"# HELP aquaflow_{name} {help_text}"
    yield f"# TYPE aquaflow_{name} {kind}"
