"""The report's sections of a survey: coverage, depth over time, the water in numbers, what is not
in the map."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

import numpy as np

from aquaflow.survey.coverage import WORDS, CoverageClass, PageView, visibility
from aquaflow.survey.report.data import DepthProfile, LeftOut, MediumCurves, ReportData
from aquaflow.survey.report.figures import coverage_svg, profile_svg

Rows = list[tuple[str, ...]]


def coverage(data: ReportData) -> str:
    """What the camera has seen, from above, and beside it what that looks like."""
    view = data.coverage
    if view is None:
        return ""
    table = _table(coverage_rows(view))
    return _section("What was seen", coverage_words(view), coverage_svg(view) + table) + overview(
        data.overview
    )


def coverage_words(view: PageView) -> str:
    """How to read the plan view."""
    said = (
        "The ground in plan view: seen well is what at least as many keyframes as are wanted see "
        "from within the range that the water allows, and from more than one direction."
    )
    return said if view.plan.limit is not None else said + " No water was found that limits it."


def coverage_rows(view: PageView) -> Rows:
    """Areas, lines and overlap."""
    unit = "m\u00b2" if view.unit == "m" else "square map units"
    total = sum(view.area(seen) for seen in CoverageClass)
    rows: Rows = [
        (WORDS[seen], f"{view.area(seen):.3g} {unit} ({100.0 * view.area(seen) / total:.0f} %)")
        for seen in (CoverageClass.WELL, CoverageClass.SPARSE, CoverageClass.TOO_FAR)
        if total > 0.0
    ]
    state, limit = view.state, view.plan.limit
    if limit is not None:
        rows.append(("range that the water allows", f"{limit * view.scale:.2g} {view.unit}"))
    if state.lines:
        length = sum(line.length for line in state.lines)
        rows.append(("survey lines", f"{len(state.lines)}, together {length:.4g} {view.unit}"))
        rows.append(("width of the swath", f"{state.swath:.3g} {view.unit}"))
    if state.overlap is not None:
        said = f"{100.0 * state.overlap:.0f} % of the swath"
        gap = f"none: a gap of {-state.overlap * state.swath:.2g} {view.unit}"
        rows.append(("overlap of the last two lines", said if state.overlap >= 0.0 else gap))
    return rows


def overview(png: bytes | None) -> str:
    """The map from straight above, without water."""
    if png is None:
        return ""
    source = "data:image/png;base64," + base64.b64encode(png).decode("ascii")
    return _section(
        "The map from above",
        "Drawn from the map without water, as seen from straight above; aquaflow export --format "
        "ortho writes it as a GeoTIFF.",
        f'<figure class="overview"><img alt="the map from above" src="{source}"></figure>',
    )


def profile(data: DepthProfile | None) -> str:
    """Depth and altitude over time."""
    if data is None:
        return ""
    said = "As the vehicle measured them; the time is that of the recording."
    return _section("Depth and altitude", said, profile_svg(data))


def water(data: MediumCurves | None) -> str:
    """The water in the numbers that a scientist asks for."""
    if data is None:
        return ""
    per = "per metre" if data.unit == "m" else "per map unit"
    said = (
        f"Rates are {per}, of the camera's red, green and blue; light is a share of the camera's "
        "full scale. Visibility is where an eye just sees a black target, 3.9 over the attenuation "
        "of the clearest channel (Koschmieder 1924)."
    )
    head = "<tr><th></th>" + "".join(f'<th class="n">{name}</th>' for name in RGB) + "</tr>"
    body = "".join(
        f"<tr><td>{html.escape(name)}</td>"
        + "".join(f'<td class="n">{value}</td>' for value in values)
        + "</tr>"
        for name, *values in water_rows(data)
    )
    seen = visibility_words(data)
    return _section(
        "The water in numbers", said, f'<table>{head}{body}</table><p class="after">{seen}</p>'
    )


RGB = ("red", "green", "blue")
"""Channels in their order."""


def water_rows(data: MediumCurves) -> Rows:
    """Name and one value for each channel."""
    per = "1/m" if data.unit == "m" else "1/map unit"
    named = (
        (f"attenuation of the scene's light, {per}", data.beta, "{:.3f}"),
        (f"backscatter coefficient, {per}", data.b, "{:.3f}"),
        ("backscatter of endless water, share", data.B_inf, "{:.3f}"),
        (f"decay of near backscatter, {per}", data.d, "{:.3f}"),
        ("near backscatter, share", data.B_res, "{:.3f}"),
    )
    rows: Rows = [(name, *(form.format(value) for value in values)) for name, values, form in named]
    halves = [f"{np.log(2.0) / value:.2f}" if value > 0.0 else "" for value in data.beta]
    rows.append((f"half of the light is lost over, {data.unit}", *halves))
    return rows


def visibility_words(data: MediumCurves) -> str:
    """Visibility, in a sentence."""
    found = visibility(data.beta)
    if found is None:
        return "Visibility is not limited by the water that was found."
    looked = f"{data.range_p5:.2g} to {data.range_p95:.2g} {data.unit}"
    said = f"Visibility: {found:.2g} {data.unit}; this dive looked {looked} far."
    beyond = " It is extrapolated from what was looked at." if found > 2.0 * data.range_p95 else ""
    return html.escape(said + beyond)


def left_out(rows: Sequence[LeftOut]) -> str:
    """Frames that are not in the map, by reason."""
    if not rows:
        return ""
    body = "".join(
        f"<tr><td>{html.escape(row.kind)}</td><td>{html.escape(row.reason)}</td>"
        f'<td class="n">{row.count:,}</td></tr>'
        for row in rows
    )
    return _section(
        "What was left out, and why",
        "Frames without a pose, and those that could not help; frames.csv has each.",
        f'<table><tr><th>result</th><th>why</th><th class="n">frames</th></tr>{body}</table>',
    )


def _table(rows: Rows) -> str:
    cells = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>"
        for name, value in rows
    )
    return f"<table>{cells}</table>"


def _section(title: str, sentence: str, body: str) -> str:
    return f"<section><h2>{title}</h2><p>{html.escape(sentence)}</p>{body}</section>\n"
