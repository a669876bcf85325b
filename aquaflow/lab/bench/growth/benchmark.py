"""``aquaflow lab bench growth``: surveys of several lengths, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.lab.bench import machine
from aquaflow.lab.bench.growth.job import GrowthJob, Instruments
from aquaflow.lab.bench.picture import COLOURS
from aquaflow.lab.bench.runner import answer_of
from aquaflow.lab.synthetic.survey_plan import SurveyScene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WORKER = "aquaflow.lab.bench.growth.worker"
"""A survey has a process of its own, so that its memory is its own too."""
JSON_FILE, TABLE_FILE, PICTURE_FILE = "growth.json", "growth.md", "growth.png"
"""What a benchmark writes."""

FRAMES = (1000, 5000, 20_000)
"""Lengths of the surveys: 1.7, 8 and 33 minutes at 10 pictures a second."""
QUICK_FRAMES = (150, 300)
"""Long enough that a second line begins."""
LEAST_FRAMES = 50
"""The shortest survey in which a map is sure to start before half of it is over."""

Progress = Callable[[str, int, int | None], None]
Row = dict[str, Any]
Perform = Callable[[GrowthJob], Row]


def bench_growth(
    jobs: Sequence[GrowthJob], out: Path, progress: Progress, perform: Perform | None = None
) -> dict[str, Any]:
    """Run the jobs; writes the result, its table and its picture into ``out``.

    Raises:
        InputError: ``out`` cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {out}: {error.strerror}; give another --out") from error
    described, rows = machine.describe(), []
    progress("surveys", 0, len(jobs))
    for done, job in enumerate(jobs, 1):
        answer = (perform or _in_process)(job)
        rows.append({**asdict(job), "load": machine.load(), "failed": None, **answer})
        progress("surveys", done, len(jobs))
    result = {"machine": described, "rows": rows}
    write_json(out / JSON_FILE, result)
    with atomic_write(out / TABLE_FILE) as stream:
        stream.write(f"{caption(described, rows)}\n\n{markdown(rows)}".encode())
    draw(rows, out / PICTURE_FILE, caption(described, rows))
    return result


def jobs_of(
    frames: Sequence[int],
    width: int,
    preset: str,
    tracking_only: bool,
    out: Path,
    scene: SurveyScene = "lines",
    telemetry: Instruments = "none",
    settings: Path | None = None,
) -> list[GrowthJob]:
    """A job for each number of frames, the shortest first.

    Raises:
        InputError: the file of ``settings`` cannot be read.
        ArgumentError: a survey is too short for a map, or there is no such preset.
    """
    if min(frames) < LEAST_FRAMES:
        raise ArgumentError(f"--frames {min(frames)} is too short; give at least {LEAST_FRAMES}")
    written = None if settings is None else str(settings)
    jobs = [
        GrowthJob(
            count,
            width,
            str(out / f"dive_{count}"),
            preset,
            tracking_only,
            scene,
            telemetry,
            written,
        )
        for count in sorted(set(frames))
    ]
    jobs[0].config()
    return jobs


def _in_process(job: GrowthJob) -> Row:
    return answer_of(WORKER, job.to_text())


# --------------------------------------------------------------------------------------------------
# ``growth.json`` as a Markdown table.

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


# --------------------------------------------------------------------------------------------------
# What grows with a dive, and what does not: a panel for each quantity, over the frames.

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
PICTURE_COLUMNS = 3


def draw(rows: Sequence[Row], path: Path, title: str) -> None:
    """Write the PNG; the number of frames is on a logarithmic axis, all else begins at zero."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    done = [row for row in rows if not row["failed"]]
    size = PANEL_INCHES[0] * PICTURE_COLUMNS, PANEL_INCHES[1] * 2
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    panels = iter(figure.subplots(2, PICTURE_COLUMNS).flat)
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
