"""``growth.json`` as a Markdown table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from aquaflow.lab.bench import machine

Row = dict[str, Any]

COLUMNS = (
    "frames", "tracking", "mapping", "graph", "keyframes", "Gaussians", "MB resident",
    "dive, MB per 1000", "checkpoint, MB per 1000", "end, CPU s", "viewer, s",
)  # fmt: skip
NO_NUMBER = "-"
"""Where there is none."""


def caption(described: dict[str, Any], rows: Sequence[Row]) -> str:
    """Machine and settings, and how to read the table."""
    row = rows[0]
    kind = "tracking only" if row["tracking_only"] else f"preset {row['preset']}"
    return (
        f"AquaFlow {described['aquaflow']} on {machine.in_words(described)}, "
        f"{described['date']}; synthetic survey, {row['width']} px, {kind}, one thread"
    )


def markdown(rows: Sequence[Row]) -> str:
    """A line for each survey, and what the columns mean."""
    lines = [f"| {' | '.join(COLUMNS)} |", f"|{'---:|' * len(COLUMNS)}"]
    lines += [f"| {' | '.join(_cells(row))} |" for row in rows]
    return "\n".join(lines) + (
        "\n\nTracking, mapping and graph: CPU ms per frame in the first and in the last tenth of "
        "the dive. MB resident: before the first frame, after the last one, and the peak, the end "
        "of the dive included. Dive: its folder when the last frame was in. End: CPU time of the "
        "last adjustment, refining, evaluation and files. Viewer: seconds until it answered with "
        "the page and until the map had come.\n"
    )


def _cells(row: Row) -> list[str]:
    if row["failed"]:
        return [str(row["frames"]), row["failed"], *[NO_NUMBER] * (len(COLUMNS) - 2)]
    first, last = row["tenths"][0], row["tenths"][-1]
    parts = [
        f"{first[name]:.1f}, {last[name]:.1f}" for name in ("tracking_ms", "mapping_ms", "graph_ms")
    ]
    viewer = row.get("viewer")
    return [
        str(row["frames"]),
        *parts,
        str(row["keyframes"]),
        str(row["gaussians"]),
        ", ".join(_number(row[name], ".0f") for name in ("start_mb", "end_mb", "peak_mb")),
        *(f"{per_1000(row, name):.1f}" for name in ("dive_bytes", "checkpoint_bytes")),
        f"{row['finish_cpu_s']:.0f}",
        f"{viewer['page_s']:.1f}, {viewer['map_s']:.1f}" if viewer else NO_NUMBER,
    ]


def per_1000(row: Row, name: str) -> float:
    """MB for each 1000 frames."""
    return float(row[name] / 1e6 / (row["frames"] / 1000.0))


def _number(value: float | None, form: str) -> str:
    return NO_NUMBER if value is None else format(value, form)
