"""The report's figures as inline SVG that follows the page's light or dark colours."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.dive.fixes_csv import FixRow
from aquaflow.geometry.earth import north_east
from aquaflow.survey.coverage.classes import COLOURS, WORDS, CoverageClass
from aquaflow.survey.coverage.page_view import PageView
from aquaflow.survey.coverage.picture import cells_affine
from aquaflow.survey.report.data import DepthProfile, MediumCurves, PathPlot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, GRID = "#010203", "#040506"
"""Colours that nothing else uses; in the SVG they become those of the page."""

CHANNELS = (("red", "#e8505b"), ("green", "#2fa66a"), ("blue", "#3b82d6"))
SUB_MAP_COLOURS = ("#1098ad", "#f08c00", "#7048e8", "#d6336c", "#66a80f", "#868e96")
TRUTH_COLOUR = "#e8505b"
"""Distinct on light and on dark paper; with more sub-maps the colours come again."""

TEXT_PT, TITLE_PT = 10.0, 11.0
"""Letters of labels and legends, and of titles."""

STYLE: Any = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": TEXT_PT,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GRID,
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": TITLE_PT,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "xtick.major.pad": 6.0,
    "legend.frameon": False,
}
"""Matplotlib's settings; text stays text, so that the page's font is used."""

CURVE_SAMPLES = 128
"""Points of each drawn curve."""

SIDES_IN = 0.6
"""Beside a panel: what its vertical axis takes."""
LEGEND_MARK_IN = 0.65
"""Before each text of a legend, with the space to the next one, at 10 pt."""


def path_svg(path: PathPlot) -> str:
    """The path seen from two sides: from above and from the side where gravity is known, else along
    the direction of least motion and across it."""
    figure = draw(9.0, 3.6, level_axes if path.up else path_axes, path)
    return svg_of(figure, "path")


def medium_svg(medium: MediumCurves) -> str:
    """Transmission and backscatter over range."""
    return svg_of(draw(9.0, 3.1, medium_axes, medium), "medium")


def draw(width_in: float, height_in: float, draw: Any, data: Any) -> Figure:
    """A figure in the report's style, into which ``draw`` has drawn ``data``."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        figure.patch.set_alpha(0.0)
        draw(figure, data)
        for axes in figure.axes:
            axes.patch.set_alpha(0.0)
            axes.set_axisbelow(True)
    return figure


def text_width_in(text: str, size_pt: float, weight: str = "normal") -> float:
    """Inches that a line takes in the figures' font."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(size=size_pt, weight=weight)
    return float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0]) / 72.0


def fold(text: str, width_in: float, size_pt: float, weight: str = "normal") -> list[str]:
    """Lines of ``text`` that are no wider, one at least; words that are wider are cut."""
    lines, line = [], ""
    for word in text.split():
        longer = f"{line} {word}" if line else word
        if text_width_in(longer, size_pt, weight) <= width_in:
            line = longer
            continue
        if line:
            lines.append(line)
        line = word
        while len(line) > 1 and text_width_in(line, size_pt, weight) > width_in:
            fits = len(line) - 1
            while fits > 1 and text_width_in(line[:fits], size_pt, weight) > width_in:
                fits -= 1
            lines.append(line[:fits])
            line = line[fits:]
    return [*lines, line]


def add_legend(figure: Figure, handles: Sequence[Any]) -> None:
    """Below all axes, in as many columns as the figure is wide enough for."""
    widest = max(text_width_in(handle.get_label(), TEXT_PT) for handle in handles)
    fits = int(_width_in(figure) // (widest + LEGEND_MARK_IN))
    columns = min(max(fits, 1), len(handles))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)


def _folded_title(figure: Figure, text: str, panels: int = 1) -> str:
    """Of one of so many panels side by side."""
    room = _width_in(figure) / panels - SIDES_IN
    return "\n".join(fold(text, room, TITLE_PT, "bold"))


def _width_in(figure: Figure) -> float:
    return float(figure.bbox.width / figure.dpi)


def level_axes(figure: Figure, path: PathPlot) -> None:
    """Draw a path from above, x up, and from the side with its depth, into an empty figure."""
    finite = np.isfinite(path.positions).all(axis=1)
    along = np.zeros(3)  # the horizontal direction in which the path is longest
    along[:2] = _main_directions(path.positions[finite, :2])[1][0]
    axes_3d = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], along, [0.0, 0.0, 1.0]])
    ours = path.positions @ axes_3d.T
    truth = None if path.truth is None else path.truth @ axes_3d.T
    above, side = figure.subplots(1, 2)
    for axes, (u, v) in ((above, (0, 1)), (side, (2, 3))):
        _draw_view(axes, ours, truth, path, u, v)
        axes.set_aspect("equal", adjustable="datalim")
    above.set_title(_folded_title(figure, f"From above, {path.up} up", 2))
    above.set_xlabel(f"{'east' if path.up == 'true north' else 'to the right'}, {path.unit}")
    above.set_ylabel(f"{path.up}, {path.unit}")
    side.set_title("From the side")
    side.set_xlabel(f"along the path's longest direction, {path.unit}")
    side.set_ylabel(f"{'depth' if path.depth_known else 'down'}, {path.unit}")
    side.invert_yaxis()
    add_legend(figure, above.get_legend_handles_labels()[0])


def path_axes(figure: Figure, path: PathPlot) -> None:
    """Draw the two views of a path into an empty figure."""
    finite = np.isfinite(path.positions).all(axis=1)
    centre, axes_3d = _main_directions(path.positions[finite])
    ours = (path.positions - centre) @ axes_3d.T
    truth = None if path.truth is None else (path.truth - centre) @ axes_3d.T
    panels = figure.subplots(1, 2)
    for axes, (u, v), title in zip(
        panels, ((0, 1), (0, 2)), ("Widest view", "From the side"), strict=True
    ):
        _draw_view(axes, ours, truth, path, u, v)
        axes.set_title(title)
        axes.set_xlabel(path.unit)
        axes.set_ylabel(path.unit)
        axes.set_aspect("equal", adjustable="datalim")
    add_legend(figure, panels[0].get_legend_handles_labels()[0])


def _draw_view(
    axes: Axes,
    ours: npt.NDArray[np.floating],  # [N, A] along A directions
    truth: npt.NDArray[np.floating] | None,  # [M, A] along the same
    path: PathPlot,
    u: int,
    v: int,
) -> None:
    if truth is not None:
        axes.plot(truth[:, u], truth[:, v], "--", color=TRUTH_COLOUR, lw=1.4, label="truth")
    members = np.array(path.sub_maps)
    ids = sorted(set(path.sub_maps))
    for order, sub_map in enumerate(ids):
        part = ours[members == sub_map]
        colour = SUB_MAP_COLOURS[order % len(SUB_MAP_COLOURS)]
        label = "camera path" if len(ids) == 1 else f"sub-map {sub_map}"
        axes.plot(part[:, u], part[:, v], color=colour, lw=1.8, label=label)
    keys = ours[np.array([name == "keyframe" for name in path.classes], dtype=bool)]
    axes.plot(keys[:, u], keys[:, v], "o", color=INK, ms=3.0, label="keyframe")
    axes.plot(ours[:1, u], ours[:1, v], "s", color=INK, ms=7.0, mfc="none", label="start")


def _main_directions(
    positions: npt.NDArray[np.floating],  # [M, D]
) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]:
    """Centre [D] and axes [D, D] (rows) by falling spread, each with a fixed sign."""
    centre, dimensions = positions.mean(axis=0), positions.shape[1]
    _, _, axes = np.linalg.svd(positions - centre, full_matrices=len(positions) < dimensions)
    largest = np.abs(axes).argmax(axis=1)
    return centre, axes * np.sign(axes[np.arange(dimensions), largest])[:, None]


def medium_axes(figure: Figure, medium: MediumCurves) -> None:
    """Draw the two curves of the water into an empty figure."""
    z = np.linspace(0.0, 1.5 * medium.range_p95, CURVE_SAMPLES)
    left, right = figure.subplots(1, 2)
    for channel, (name, colour) in enumerate(CHANNELS):
        passed = 100.0 * np.exp(-medium.beta[channel] * z)
        scattered = medium.B_inf[channel] * (1.0 - np.exp(-medium.b[channel] * z))
        scattered = scattered + medium.B_res[channel] * np.exp(-medium.d[channel] * z)
        left.plot(z, passed, color=colour, lw=2.0, label=name)
        right.plot(z, 100.0 * scattered, color=colour, lw=2.0, label=name)
    left.set_title("Scene light that arrives (%)")
    right.set_title("Light that the water adds (%)")
    left.set_ylim(0.0, 102.0)
    right.set_ylim(bottom=0.0)
    for axes in (left, right):
        axes.axvspan(medium.range_p5, medium.range_p95, color=GRID, alpha=0.35, lw=0.0)
        axes.set_xlim(0.0, z[-1])
        axes.set_xlabel(f"distance from the camera ({medium.unit})")
    add_legend(figure, left.get_legend_handles_labels()[0])


def svg_of(figure: Figure, salt: str) -> str:
    """Inline SVG: no header, no date, ids unique to the figure, colours those of the page."""
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": salt}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    # Matplotlib numbers its groups from one in every figure; in one page they must differ.
    svg = re.sub(
        r' id="((?:figure|axes|patch|line2d|text|legend|matplotlib\.axis|xtick|ytick)_\d+)"',
        "",
        svg,
    )
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    return svg.replace(INK, "currentColor").replace(GRID, "var(--grid)")


# --------------------------------------------------------------------------------------------------
# The report's figures of a survey: what was seen from above, and depth and altitude over time.

LONG_S = 180.0
"""From which a dive's time is shown in minutes."""
NEXT_COLOUR = "#e23ea0"
"""Of the suggested line, as in the live picture."""


def coverage_svg(view: PageView) -> str:
    """The plan view with coverage, path, lines and the next line."""
    return svg_of(draw(9.0, 4.6, coverage_axes, view), "coverage")


def profile_svg(profile: DepthProfile) -> str:
    """Depth and altitude over the time of the dive."""
    return svg_of(draw(9.0, 3.0, profile_axes, profile), "profile")


def coverage_axes(figure: Figure, view: PageView) -> None:
    """Draw a plan view into an empty figure."""
    from matplotlib.patches import Patch
    from matplotlib.transforms import Affine2D

    axes = figure.subplots()
    colours = np.zeros((len(CoverageClass), 4), np.uint8)
    for seen, colour in COLOURS.items():
        colours[seen] = (*colour, 255)
    rows, columns = view.plan.classes.shape
    affine = np.vstack([cells_affine(view), [0.0, 0.0, 1.0]])
    axes.imshow(
        colours[view.plan.classes[::-1]], extent=(0, columns, rows, 0), interpolation="nearest",
        transform=Affine2D(affine) + axes.transData, zorder=0.5,
    )  # fmt: skip
    axes.plot(*view.path.T, color=INK, lw=1.2, label="camera path")
    _lines(axes, view)
    corners = np.array([[0, 0, 1], [columns, 0, 1], [0, rows, 1], [columns, rows, 1]])
    places = np.concatenate([corners @ affine[:2].T, view.path])
    low, high = places.min(axis=0), places.max(axis=0)
    room = 0.04 * float((high - low).max())
    axes.set_xlim(low[0] - room, high[0] + room)
    axes.set_ylim(low[1] - room, high[1] + room)
    axes.set_aspect("equal", adjustable="box")
    title = _folded_title(figure, f"Seen {view.seen}, up: {view.up}")
    figure.suptitle(title, fontsize=TITLE_PT, weight="bold")
    axes.set_xlabel(f"{view.right}, {view.unit}")
    axes.set_ylabel(f"{view.up}, {view.unit}")
    patches = [
        Patch(color="#{:02x}{:02x}{:02x}".format(*COLOURS[seen]), label=WORDS[seen])
        for seen in (CoverageClass.WELL, CoverageClass.SPARSE, CoverageClass.TOO_FAR)
    ]
    handles, _ = axes.get_legend_handles_labels()
    add_legend(figure, [*patches, *handles])


def _lines(axes: Axes, view: PageView) -> None:
    for number, line in enumerate(view.state.lines):
        label = "survey line" if number == 0 else None
        axes.plot(*np.array([line.start, line.end]).T, color=INK, lw=2.4, label=label)
    if view.state.suggestion is not None:
        ends = np.array([view.state.suggestion.start, view.state.suggestion.end])
        axes.plot(*ends.T, "--", color=NEXT_COLOUR, lw=2.0, label="next line")


def profile_axes(figure: Figure, profile: DepthProfile) -> None:
    """Draw depth and altitude over time into an empty figure, as far as they are known."""
    known = [
        (values, name, down)
        for values, name, down in (
            (profile.depth, profile.depth_is, True),
            (profile.altitude, "altitude above the bottom", False),
        )
        if np.isfinite(values).any()
    ]
    long = float(np.ptp(profile.t_s)) >= LONG_S
    time, unit = (profile.t_s / 60.0, "minutes") if long else (profile.t_s, "s")
    panels = figure.subplots(1, len(known), squeeze=False)[0]
    for axes, (values, name, down), colour in zip(panels, known, SUB_MAP_COLOURS, strict=False):
        axes.plot(time, values, color=colour, lw=1.8)
        axes.set_title(_folded_title(figure, name.capitalize(), len(known)))
        axes.set_xlabel(f"time, {unit}")
        axes.set_ylabel(profile.unit)
        if down:
            axes.invert_yaxis()


# --------------------------------------------------------------------------------------------------
# Position fixes, and an arrow from each to where the dive lies.

REJECTED_COLOUR = "#e8505b"
LONGEST_ARROW = 0.15
"""Of the larger side of the plan: the longest arrow of a fix that was used, at most; those of
rejected fixes run out of the plan."""
ROUND_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""By which arrows may be drawn too long."""


def fixes_svg(fixes: Sequence[FixRow]) -> str:
    """The fixes in plan view."""
    return svg_of(draw(9.0, 4.6, fixes_axes, fixes), "fixes")


def fixes_axes(figure: Figure, fixes: Sequence[FixRow]) -> None:
    """Draw fixes and their errors, north up, into an empty figure."""
    from matplotlib.lines import Line2D

    latitudes, longitudes = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes]).T
    middle = float(latitudes.mean()), float(longitudes.mean())
    places = north_east(latitudes, longitudes, middle)[:, ::-1]
    errors = np.array([(fix.error_east_m, fix.error_north_m) for fix in fixes])
    rejected = np.array([fix.rejected for fix in fixes])
    used = errors if rejected.all() else errors[~rejected]
    size = float(np.ptp(places, axis=0).max())
    longest = LONGEST_ARROW * size / max(float(np.linalg.norm(used, axis=1).max()), 1e-9)
    times = max(factor for factor in ROUND_FACTORS if factor <= max(longest, 1.0))
    axes = figure.subplots()
    handles = []
    for chosen, colour, label in (
        (~rejected, SUB_MAP_COLOURS[0], "fix that was used"),
        (rejected, REJECTED_COLOUR, "fix that was rejected"),
    ):
        if chosen.any():
            ends = places[chosen] + times * errors[chosen]
            axes.plot(*np.stack([places[chosen], ends]).transpose(2, 0, 1), color=colour, lw=1.4)
            axes.plot(*places[chosen].T, "o", ms=4.0, color=colour)
            handles.append(Line2D([], [], color=colour, marker="o", ms=4.0, label=label))
    axes.set_aspect("equal", adjustable="box")
    low, high = places.min(axis=0), places.max(axis=0)
    room = max(1.5 * LONGEST_ARROW * size, 0.1)
    axes.set_xlim(low[0] - room, high[0] + room)
    axes.set_ylim(low[1] - room, high[1] + room)
    scale = f", drawn {times} times as long" if times > 1 else ""
    title = _folded_title(figure, f"From each fix to where the dive lies{scale}")
    figure.suptitle(title, fontsize=TITLE_PT, weight="bold")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    add_legend(figure, handles)
