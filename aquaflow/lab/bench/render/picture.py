"""Milliseconds against the number of Gaussians, a panel for each size of picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from aquaflow.lab.bench.picture import COLOURS
from aquaflow.lab.bench.render.rows import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Line = tuple[str, str, int]
"""Renderer, instruction set, threads."""

QUANTITIES: tuple[tuple[str, Callable[[Row], float]], ...] = (
    ("forward", lambda row: row["fwd_ms"]),
    ("forward + backward", lambda row: row["fwd_ms"] + row["bwd_ms"]),
)
"""What is drawn, a row of panels for each: milliseconds."""
PANEL_INCHES = (3.6, 3.1)
LEGEND_INCHES = 2.4
"""Width and height of a panel, width of the legend."""


def draw(rows: Sequence[Row], path: Path, title: str) -> None:
    """Write the PNG; both axes are logarithmic."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    pictures = list(dict.fromkeys((row["width"], row["height"]) for row in rows))
    lines = list(dict.fromkeys(_line(row) for row in rows))
    width = PANEL_INCHES[0] * max(len(pictures), 1) + LEGEND_INCHES
    figure = Figure(figsize=(width, PANEL_INCHES[1] * len(QUANTITIES)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(
        len(QUANTITIES), max(len(pictures), 1), squeeze=False, sharex="col", sharey="row"
    )
    for (name, value), row_of_panels in zip(QUANTITIES, panels, strict=True):
        row_of_panels[0].set_ylabel(f"{name}, ms (log)")
        for (w, h), axes in zip(pictures, row_of_panels, strict=True):
            here = [row for row in rows if (row["width"], row["height"]) == (w, h)]
            _panel(axes, here, lines, value)
    for (w, h), top, bottom in zip(pictures, panels[0], panels[-1], strict=True):
        top.set_title(f"{w} x {h} px", fontsize=10)
        bottom.set_xlabel("Gaussians (log)")
    figure.suptitle(title, fontsize=9, x=0.01, ha="left", color="#495057")
    handles = {h.get_label(): h for axes in panels.flat for h in axes.get_lines()}
    figure.legend(handles=list(handles.values()), loc="outside right center", frameon=False)
    figure.savefig(path, dpi=120)


def _line(row: Row) -> Line:
    return row["renderer"], row["isa"], row["threads"]


def _panel(
    axes: Axes, rows: Sequence[Row], lines: Sequence[Line], value: Callable[[Row], float]
) -> None:
    """One colour for each renderer and instruction set; dashed with more than one thread."""
    kinds = list(dict.fromkeys(line[:2] for line in lines))
    for renderer, isa, threads in lines:
        found = sorted(
            (row["n"], value(row)) for row in rows if _line(row) == (renderer, isa, threads)
        )
        if not found:
            continue
        colour = COLOURS[kinds.index((renderer, isa)) % len(COLOURS)]
        many = threads > 1
        axes.plot(
            [n for n, _ in found], [ms for _, ms in found],
            color=colour, marker="o", markersize=4.5, linewidth=1.3,
            linestyle="--" if many else "-", markerfacecolor="white" if many else colour,
            label=f"{renderer} {isa}, {threads} thread{'s' if many else ''}",
        )  # fmt: skip
    _logarithmic(axes, sorted({row["n"] for row in rows}))


def _logarithmic(axes: Axes, counts: Sequence[int]) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(True, color="#e9ecef", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(FixedLocator([float(n) for n in counts]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda n, _: _count(n)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda ms, _: f"{ms:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _count(n: float) -> str:
    return f"{n / 1000:g}k" if n >= 1000 else f"{n:g}"
