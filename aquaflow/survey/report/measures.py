"""The report's sections on the ground, on metres, gravity and north, and on telemetry."""

from __future__ import annotations

import html
from collections.abc import Sequence

from aquaflow.survey.report.data import Measures, ReefRow
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
