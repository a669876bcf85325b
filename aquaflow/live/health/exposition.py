"""Prometheus' text format 0.0.4 (prometheus.io/docs/instrumenting/exposition_formats)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, TypeAlias

TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Content type of the format."""
Kind: TypeAlias = Literal["counter", "gauge"]


def head(name: str, kind: Kind, help_text: str) -> Iterator[str]:
    """The lines before the samples of a metric, which all follow without a gap."""
    yield f"# HELP aquaflow_{name} {help_text}"
    yield f"# TYPE aquaflow_{name} {kind}"


def sample(name: str, value: float, **labels: str) -> str:
    """One line: a value, and the labels that tell it from the others of its metric."""
    told = ",".join(f'{key}="{_escape(text)}"' for key, text in labels.items())
    return f"aquaflow_{name}{{{told}}} {value}" if told else f"aquaflow_{name} {value}"


def label(
    name: str, label: str, values: Mapping[str, float], help_text: str, kind: Kind = "counter"
) -> Iterator[str]:
    """A metric whose values are told apart by one label."""
    yield from head(name, kind, help_text)
    for text, value in values.items():
        yield sample(name, value, **{label: text})


def _escape(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


# --------------------------------------------------------------------------------------------------
# What each counter of a device says; a test holds these tables to the drivers' counters.

RECEIVED = ("received", "delivered", "bytes", "messages", "samples")
"""What came."""
NOT_ASKED_FOR = ("overtaken", "passed_over")
"""Pictures that tracking had no time for, or was told to leave out."""
DROPPED = ("lost", "stale", "unusable", "duplicates", "dropped_samples")
"""What was lost on its way, or could not be used."""
ERRORS = ("bad_checksums", "garbage_bytes", "invalid_values", "unheard", "stamps_repaired")
"""What came and was not understood, or was corrected."""
RECONNECTS = "reconnects"


# --------------------------------------------------------------------------------------------------
# Each camera, link and recorder as Prometheus reads it.

WORKING = ("streaming", "connected", "recording")
"""States of a device that does what it is there for."""
COUNTERS = {
    "received": (RECEIVED, "Pictures, samples, messages and bytes that came."),
    "not_asked_for": (NOT_ASKED_FOR, "Pictures that tracking had no time for or left out."),
    "dropped": (DROPPED, "What was lost on its way, or could not be used."),
    "errors": (ERRORS, "What came and was not understood, or was corrected."),
}
"""Metric: the counters that it tells apart by the label ``what``, and its help."""
GAUGES = {
    "rate_hertz": ("rate_hz", 1.0, "Pictures or samples per second, lately."),
    "age_seconds": ("age_s", 1.0, "Age of the newest picture or sample."),
    "lag_seconds": ("lag_ms", 1e3, "From measurement to arrival, mean of the last seconds."),
}
"""Metric: key in the report, its units in the metric's unit, help."""

Devices = Mapping[str, Mapping[str, Any]]


def device_lines(devices: Devices) -> Iterator[str]:
    """The metrics of ``devices``, as the report has them."""
    yield from head("device_up", "gauge", "1 while the device delivers.")
    for name, device in devices.items():
        yield sample("device_up", int(device["state"] in WORKING), device=name, kind=device["kind"])
    yield from head("device_state", "gauge", "1 for the state that the device is in.")
    for name, device in devices.items():
        yield sample("device_state", 1, device=name, kind=device["kind"], state=device["state"])
    for metric, (keys, help_text) in COUNTERS.items():
        yield from head(f"device_{metric}_total", "counter", help_text)
        for name, device in devices.items():
            for key in keys:
                if key in device:
                    yield sample(f"device_{metric}_total", device[key], device=name, what=key)
    yield from head("device_reconnects_total", "counter", "Times that the device came back.")
    for name, device in devices.items():
        if RECONNECTS in device:
            yield sample("device_reconnects_total", device[RECONNECTS], device=name)
    for metric, (key, divisor, help_text) in GAUGES.items():
        yield from head(f"device_{metric}", "gauge", help_text)
        for name, device in devices.items():
            if device.get(key) is not None:
                yield sample(f"device_{metric}", device[key] / divisor, device=name)
