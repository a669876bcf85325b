"""The report's sections on the ground, on metres, gravity and north, on telemetry and fixes."""

from __future__ import annotations

import html
from collections.abc import Sequence

from aquaflow.dive.fixes_csv import FixRow
from aquaflow.survey.report.data import Measures, ReefRow, ReportData
from aquaflow.survey.report.figures import fixes_svg
from aquaflow.telemetry.world_frame import SourceReport


def measures(data: Measures | None) -> str:
    """Lengths with their uncertainty, then every source of telemetry and what became of it."""
    if data is None:
        return ""
    rows = "".join(
        f"<tr><td>{html.escape(what)}</td><td>{html.escape(value)}</td></tr>"
        for what, value in data.rows
    )
    said = "Lengths and directions, each with 1 sigma where it is known."
    return (
        f"<section><h2>Metres, gravity and north</h2><p>{said}</p><table>{rows}</table>"
        f"{_sources(data.sources)}</section>"
    )


def reef(rows: Sequence[ReefRow]) -> str:
    """What a survey is made for: the ground in numbers."""
    if not rows:
        return ""
    cells = "".join(
        f'<tr><td>{html.escape(row.label)}</td><td class="value">{html.escape(row.value)}</td>'
        f'<td class="value">{html.escape(row.interval)}</td>'
        f"<td>{html.escape(row.meaning)}</td></tr>"
        for row in rows
    )
    return (
        "<section><h2>The ground in numbers</h2><p>Each with 1 sigma, and the interval that holds "
        "the truth with 95 %. They are of the largest sub-map; reef_numbers.csv has them too.</p>"
        "<table><tr><th>what</th><th>value</th><th>95 %</th><th>meaning</th></tr>"
        f"{cells}</table></section>"
    )


def _sources(sources: Sequence[SourceReport]) -> str:
    if not sources:
        return "<p>No telemetry was used.</p>"
    rows = "".join(
        f"<tr><td>{html.escape(each.source)}</td><td>{html.escape(each.kind)}</td>"
        f'<td class="n">{each.used:,}</td><td class="n">{each.rejected:,}</td>'
        f"<td>{html.escape(each.reason)}</td></tr>"
        for each in sources
    )
    return (
        "<p>Telemetry: samples used, samples rejected because they contradicted the others, and "
        'why.</p><table><tr><th>source</th><th>kind</th><th class="n">used</th>'
        f'<th class="n">rejected</th><th>why</th></tr>{rows}</table>'
    )


# --------------------------------------------------------------------------------------------------
# Position fixes and their errors, as surveyors judge a survey.

MOST_FIXES = 40
"""Rows of the table; of more fixes those with the largest errors, as fixes.csv has all."""
FIX_COLUMNS = (
    ("fix", False), ("source", False), ("east, m", True), ("north, m", True), ("error, m", True),
    ("sigmas", True), ("", False),
)  # fmt: skip
"""Each with whether it has numbers."""
FixCells = tuple[str, str, str, str, str, str, str]


def fixes(data: ReportData) -> str:
    """Plan view, then the table."""
    if not data.fixes:
        return ""
    head = "".join(
        f'<th class="n">{name}</th>' if numeric else f"<th>{name}</th>"
        for name, numeric in FIX_COLUMNS
    )
    body = "".join(_fix_row(cells) for cells in fix_cells(data.fixes))
    return (
        f"<section><h2>Position fixes</h2><p>{fix_words(data)}</p>{fixes_svg(data.fixes)}"
        f"<table><tr>{head}</tr>{body}</table></section>"
    )


def _fix_row(cells: FixCells) -> str:
    name, source, *numbers, result = (html.escape(cell) for cell in cells)
    return (
        f"<tr><td>{name}</td><td>{source}</td>"
        + "".join(f'<td class="n">{number}</td>' for number in numbers)
        + f"<td>{result}</td></tr>"
    )


def fix_words(data: ReportData) -> str:
    """What the errors are, together and of the fixes that are listed."""
    found = data.metrics.get("fixes") or {}
    said = "Where the dive lies at each fix, less the fix; horizontally, as fixes have no height."
    if found.get("rms_m") is not None:
        used = found["count"] - found["rejected"]
        said += (
            f" Of the {used:,} that were not rejected: RMS {found['rms_m']:.3g} m, "
            f"{found['rms_sigmas']:.2g} of the sigma that they state, largest "
            f"{found['largest_m']:.3g} m."
        )
    if found.get("rejected"):
        said += f" {found['rejected']:,} contradicted those around them and took no part."
    if len(data.fixes) > MOST_FIXES:
        said += f" The {MOST_FIXES} with the largest errors are listed; fixes.csv has all."
    return said


def fix_cells(fixes: Sequence[FixRow]) -> list[FixCells]:
    """Rows of the table, in the order of time."""
    chosen = sorted(fixes, key=lambda fix: -fix.error_m)[:MOST_FIXES]
    return [
        (
            fix.picture or f"{fix.t_s:.2f} s", fix.source, f"{fix.error_east_m:+.3f}",
            f"{fix.error_north_m:+.3f}", f"{fix.error_m:.3f}", f"{fix.error_sigmas:.1f}",
            "rejected" if fix.rejected else "",
        )
        for fix in sorted(chosen, key=lambda fix: fix.t_s)
    ]  # fmt: skip
