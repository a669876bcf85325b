"""The benchmark as a table: for the terminal, and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from aquaflow.lab.bench.summary import COLUMNS, NOTES, TOTAL_MS, Column, SummaryLine, lines_of

Row = dict[str, Any]


def print_table(rows: Sequence[Row], console: Console) -> None:
    """Medians and spread of every contender on every scene, then what failed and why."""
    table = Table(show_edge=False, pad_edge=False)
    table.add_column("scene")
    table.add_column("run")
    columns = measured_columns(rows)
    for column in columns:
        table.add_column(column.title, justify="right", no_wrap=True)
    before = None
    for line in lines_of(rows):
        if before not in (None, line.scene):
            table.add_section()
        scene, before = ("" if line.scene == before else line.scene), line.scene
        table.add_row(scene, line.contender, *_cells(line, columns))
    console.print(table)
    for sentence in (*failures(rows), *features(rows), *NOTES):
        console.print(sentence, highlight=False, markup=False)


def measured_columns(rows: Sequence[Row]) -> list[Column]:
    """Those that some run has a number for; time per frame always, as failures stand there."""
    lines = lines_of(rows)
    return [
        column
        for column in COLUMNS
        if column is TOTAL_MS or any(line.spread(column) for line in lines)
    ]


def _cells(line: SummaryLine, columns: Sequence[Column]) -> list[str]:
    if len(line.failures) == len(line.rows):
        return ["failed" if column is TOTAL_MS else "-" for column in columns]
    return [line.cell(column) for column in columns]


def failures(rows: Sequence[Row]) -> list[str]:
    """One sentence for every contender and scene with runs that failed."""
    said = []
    for line in lines_of(rows):
        if line.failures:
            reason = line.failures[0].rstrip(".")
            said.append(
                f"{line.scene}, {line.contender}: {len(line.failures)} of {len(line.rows)} runs "
                f"failed: {reason}."
            )
    return said


def features(rows: Sequence[Row]) -> list[str]:
    """One sentence for every peer that says what it matched."""
    said = {row["peer"]: row["features"] for row in rows if row.get("features")}
    return [f"{peer} ran with {found}." for peer, found in said.items()]


def markdown(rows: Sequence[Row]) -> str:
    """The same table for a page."""
    columns = measured_columns(rows)
    titles = ["scene", "run", *(column.title for column in columns)]
    ruler = ["---", "---", *("---:" for _ in columns)]
    body = [[line.scene, line.contender, *_cells(line, columns)] for line in lines_of(rows)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (titles, ruler, *body))
