"""What grows with a dive, and what does not: a panel for each quantity, over the frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aquaflow.lab.bench.growth.table import per_1000
from aquaflow.lab.bench.picture import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = dict[str, Any]

ALONG: tuple[tuple[str, str], ...] = (
    ("tracking, CPU ms per frame", "tracking_ms"),
    ("mapping, CPU ms per frame", "mapping_ms"),
    ("graph, CPU ms per frame", "graph_ms"),
    ("resident, MB", "resident_mb"),
)
"""Panels with a line for each dive, a point for each of its tenths."""
AT_THE_END: tuple[tuple[str, str, Callable[[Row], float | None]], ...] = (
    ("MB per 1000 frames", "dive folder", lambda row: per_1000(row, "dive_bytes")),
    ("MB per 1000 frames", "checkpoint", lambda row: per_1000(row, "checkpoint_bytes")),
    ("viewer, s", "page", lambda row: (row.get("viewer") or {}).get("page_s")),
    ("viewer, s", "map", lambda row: (row.get("viewer") or {}).get("map_s")),
)
"""Panel, line and value: a point for each dive."""
PANEL_INCHES = (4.0, 3.0)
COLUMNS = 3


def draw(rows: Sequence[Row], path: Path, title: str) -> None:
    """Write the PNG; the number of frames is on a logarithmic axis, all else begins at zero."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    done = [row for row in rows if not row["failed"]]
    size = PANEL_INCHES[0] * COLUMNS, PANEL_INCHES[1] * 2
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    panels = iter(figure.subplots(2, COLUMNS).flat)
    for label, key in ALONG:
        _along_the_dives(next(panels), label, key, done)
    for label in dict.fromkeys(panel for panel, _, _ in AT_THE_END):
        _at_the_end(next(panels), label, done)
    figure.suptitle(title, fontsize=9, x=0.01, ha="left", color="#495057")
    figure.savefig(path, dpi=120)


def _along_the_dives(axes: Axes, label: str, key: str, rows: Sequence[Row]) -> None:
    for row, colour in zip(rows, COLOURS, strict=False):
        known = [each for each in row["tenths"] if each[key] is not None]
        at = [each["frames"] for each in known]
        values = [each[key] for each in known]
        axes.plot(at, values, "o-", ms=3, color=colour, label=f"dive of {row['frames']}")
    _label(axes, label)


def _at_the_end(axes: Axes, label: str, rows: Sequence[Row]) -> None:
    lines = [(name, value) for panel, name, value in AT_THE_END if panel == label]
    for (name, value), colour in zip(lines, COLOURS, strict=False):
        points = [(row["frames"], value(row)) for row in rows]
        known = [(frames, at) for frames, at in points if at is not None]
        axes.plot(*zip(*known, strict=True), "o-", ms=4, color=colour, label=name) if known else ()
    _label(axes, label)


def _label(axes: Axes, label: str) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.set_xscale("log")
    # Few whole numbers: the default of a short axis writes one over the other.
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("frames (log)")
    axes.set_title(label, fontsize=10)
    axes.set_ylim(bottom=0.0)
    axes.grid(visible=True, alpha=0.3)
    if axes.get_lines():
        axes.legend(frameon=False, fontsize=8)
