"""Run time against error as one picture: every run, the Pareto front, and what failed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aquaflow.lab.bench.summary import ATE_PCT, PSNR, TOTAL_MS, Column, contender_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Row = dict[str, Any]

COLOURS = (
    "#1098ad", "#e8590c", "#7048e8", "#2f9e44", "#d6336c", "#b08900", "#495057", "#1c7ed6",
    "#a61e4d", "#5c940d",
)  # fmt: skip
"""Of the scenes, in turn."""
SHAPES = {"fast": "^", "balanced": "o", "accurate": "s", "two-view": "v", "colmap": "D"}
OTHER_SHAPE = "P"
"""Markers of the contenders."""
FRONT = "#868e96"
"""Grey for what belongs to no scene."""
MARKER_SIZE = 52.0
"""Points squared, as Matplotlib has it."""
FEW_DIGITS = 10.0
"""Ratio of an axis' ends above which not every digit is labelled: 1, 2 and 5 are."""
LONE_DIGITS = 1000.0
"""Ratio above which 1 alone is: the labels of four decades would run into each other."""
EMPTY = (1.0, 1000.0)
"""Ends of the axes where every run failed."""
MARGIN = 0.025
"""Height at which failed runs are marked, as a share of the axes."""


def draw(rows: Sequence[Row], path: Path, title: str) -> None:
    """Write the PNG: time per frame against ATE, and against held-out PSNR."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    colours = _colours(rows)
    _axes(left, rows, ATE_PCT, colours, better_is_lower=True)
    left.set_yscale("log")
    _plain_numbers(left.yaxis)
    left.set_ylabel("ATE after Sim(3), % of the path (log)")
    _axes(right, rows, PSNR, colours, better_is_lower=False)
    right.set_ylabel("held-out PSNR, dB (itself a logarithm)")
    figure.suptitle(title, fontsize=10, x=0.01, ha="left", color="#495057")
    _legend(figure, rows, colours)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def _colours(rows: Sequence[Row]) -> dict[str, str]:
    scenes = dict.fromkeys(row["scene"] for row in rows)
    return {scene: COLOURS[i % len(COLOURS)] for i, scene in enumerate(scenes)}


def _axes(
    axes: Axes,
    rows: Sequence[Row],
    error: Column,
    colours: dict[str, str],
    better_is_lower: bool,
) -> None:
    axes.set_xscale("log")
    axes.set_xlabel("milliseconds per frame, refining included (log)")
    axes.grid(True, which="both", color="#e9ecef", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    points = [
        (TOTAL_MS.value(row) or 0.0, error.value(row) or 0.0, row)
        for row in rows
        if not row["failed"]
    ]
    shown = [(x, y, row) for x, y, row in points if _drawable(x) and _drawable(y)]
    for x, y, row in shown:
        axes.scatter(
            x, y, MARKER_SIZE, marker=shape_of(row), color=colours[row["scene"]],
            edgecolors="white", linewidths=0.7, zorder=3,
        )  # fmt: skip
    if not shown:  # a logarithmic axis has no limits of its own
        axes.set_xlim(*EMPTY)
        axes.set_ylim(*EMPTY)
    _fronts(axes, shown, colours, better_is_lower)
    _plain_numbers(axes.xaxis)
    _mark_failed(axes, [row for row in rows if row["failed"]], colours)
    axes.set_title(
        ("lower left is better" if better_is_lower else "upper left is better"),
        fontsize=9, loc="right", color="#868e96",
    )  # fmt: skip


def _plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis in plain digits, each where it spans little, else 1, 2, 5, 10."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    subs = tuple(float(k) for k in range(1, 10))
    if high > FEW_DIGITS * low:
        subs = (1.0,) if high > LONE_DIGITS * low else (1.0, 2.0, 5.0)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _drawable(value: float) -> bool:
    """Nothing measured, nor zero, has a place on a logarithmic axis."""
    return math.isfinite(value) and value > 0.0


def shape_of(row: Row) -> str:
    """The marker of the run that a row is of."""
    return SHAPES.get(contender_of(row), OTHER_SHAPE)


def _fronts(
    axes: Axes,
    shown: list[tuple[float, float, Row]],
    colours: dict[str, str],
    better_is_lower: bool,
) -> None:
    """One front for each scene: what a scene's error can be depends on the scene."""
    sign = 1.0 if better_is_lower else -1.0
    for scene, colour in colours.items():
        here = [(x, y) for x, y, row in shown if row["scene"] == scene]
        front = pareto_front([x for x, _ in here], [sign * y for _, y in here])
        axes.plot(
            [here[i][0] for i in front], [here[i][1] for i in front],
            drawstyle="steps-post", color=colour, linewidth=1.2, alpha=0.55, zorder=2,
        )  # fmt: skip


def _mark_failed(axes: Axes, failed: list[Row], colours: dict[str, str]) -> None:
    """A cross at the lower margin for each run that failed, in its scene's colour."""
    for i, row in enumerate(failed):
        x = 0.02 + 0.96 * (i + 0.5) / max(len(failed), 12)
        axes.scatter(
            x, MARGIN, MARKER_SIZE, marker="x", color=colours[row["scene"]],
            transform=axes.transAxes, clip_on=False, zorder=4,
        )  # fmt: skip
        axes.annotate(
            contender_of(row), (x, MARGIN), (0, 7), xycoords="axes fraction",
            textcoords="offset points", fontsize=6, ha="center", color="#868e96",
        )  # fmt: skip


def _legend(figure: Figure, rows: Sequence[Row], colours: dict[str, str]) -> None:
    from matplotlib.lines import Line2D

    def handle(label: str, colour: str, marker: str) -> Line2D:
        return Line2D([], [], color=colour, marker=marker, linestyle="", label=label)

    scenes = [handle(scene, colour, "o") for scene, colour in colours.items()]
    names = dict.fromkeys((contender_of(row), shape_of(row)) for row in rows)
    kinds = [handle(name, "#343a40", shape) for name, shape in names]
    kinds.append(Line2D([], [], color=FRONT, label="Pareto front of a scene"))
    if any(row["failed"] for row in rows):
        kinds.append(handle("failed: no error to show", FRONT, "x"))
    figure.legend(
        handles=[*scenes, *kinds], loc="outside right center", fontsize=8.5, frameon=False
    )


# --------------------------------------------------------------------------------------------------
# The Pareto front: the runs that no other run improves in both time and error.


def pareto_front(cost: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices of the points with no other as cheap and as good, and better in one; by cost."""
    order = sorted(range(len(cost)), key=lambda i: (cost[i], error[i]))
    front: list[int] = []
    for i in order:
        if not front or error[i] < error[front[-1]]:
            front.append(i)
    return front
