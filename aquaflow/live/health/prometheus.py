"""The report as Prometheus reads it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from aquaflow.live.health.exposition import head, labelled, sample
from aquaflow.live.health.prometheus_devices import device_lines
from aquaflow.live.health.state import State

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
QUANTILES = {"p50": "0.5", "p95": "0.95"}
"""Of the lag: the report's keys and Prometheus' labels."""


def exposition(report: Mapping[str, Any]) -> str:
    """The metrics of one report."""
    return "".join(f"{line}\n" for line in _lines(report))


def _lines(report: Mapping[str, Any]) -> Iterator[str]:
    states = {state.value: int(report["state"] == state.value) for state in State}
    yield from labelled(
        "state", "state", states, "1 for the state that the service is in.", "gauge"
    )
    yield from head("ok", "gauge", "1 while nothing is to be done about it.")
    yield sample("ok", int(report["ok"]))
    for name, help_text in COUNTERS.items():
        yield from head(f"{name}_total", "counter", help_text)
        yield sample(f"{name}_total", report[name])
    for name, help_text in GAUGES.items():
        yield from head(name, "gauge", help_text)
        yield sample(name, report[name])
    lags = {quantile: report["lag_ms"][key] for key, quantile in QUANTILES.items()}
    lags_s = {quantile: lag_ms / 1e3 for quantile, lag_ms in lags.items() if lag_ms is not None}
    yield from labelled(
        "lag_seconds", "quantile", lags_s, "From a frame's arrival to its pose, last minute.",
        "gauge",
    )  # fmt: skip
    yield from labelled("frames_by_class_total", "class", report["classes"], "Frames by result.")
    yield from labelled(
        "left_out_total", "reason", report["left_out_of_the_map"], "Frames that the map never saw."
    )
    yield from labelled("state_visits_total", "state", report["visits"], "Times in each state.")
    yield from head("stage_failures_total", "counter", "Failures of a stage, by exception.")
    for kind in report["stage_failures"]:
        labels = {key: kind[key] for key in ("stage", "error", "place")}
        yield sample("stage_failures_total", kind["count"], **labels)
    poses = report["pose_output"]
    if poses is not None:
        yield from head("poses_sent_total", "counter", "Poses sent to the autopilot.")
        yield sample("poses_sent_total", poses["sent"])
        yield from labelled(
            "poses_withheld_total", "reason", poses["withheld"], "Poses not sent to the autopilot."
        )
    yield from labelled(
        "stage_share", "stage", report["stage_shares"], "Seconds per second in a stage.", "gauge"
    )
    yield from device_lines(report["devices"])
