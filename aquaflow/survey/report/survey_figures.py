"""The report's figures of a survey: what was seen from above, and depth and altitude over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from aquaflow.survey.coverage import COLOURS, WORDS, CoverageClass, PageView
from aquaflow.survey.coverage.picture import cells_affine
from aquaflow.survey.report.data import DepthProfile
from aquaflow.survey.report.figures import INK, SUB_MAP_COLOURS, draw, svg_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    axes.set_title(f"Seen {view.seen}, up: {view.up}")
    axes.set_xlabel(f"{view.right}, {view.unit}")
    axes.set_ylabel(f"{view.up}, {view.unit}")
    patches = [
        Patch(color="#{:02x}{:02x}{:02x}".format(*COLOURS[seen]), label=WORDS[seen])
        for seen in (CoverageClass.WELL, CoverageClass.SPARSE, CoverageClass.TOO_FAR)
    ]
    handles, _ = axes.get_legend_handles_labels()
    figure.legend(handles=[*patches, *handles], loc="outside lower center", ncols=3)


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
        axes.set_title(name.capitalize())
        axes.set_xlabel(f"time, {unit}")
        axes.set_ylabel(profile.unit)
        if down:
            axes.invert_yaxis()
