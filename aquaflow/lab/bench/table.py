"""The benchmark as a table: for the terminal, and as Markdown."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.storage.atomic import atomic_write
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


# --------------------------------------------------------------------------------------------------
# A page's section on speed and accuracy: its numbers are written here, not typed.

BEGIN, END = "<!-- bench: begin -->", "<!-- bench: end -->"
"""Comments between which the results stand."""


def write_readme(
    readme: Path, picture: Path, machine: dict[str, Any], rows: Sequence[dict[str, Any]]
) -> None:
    """Replace what stands between the markers; the picture is copied next to the file.

    Raises:
        InputError: the file or its markers are not there.
    """
    before, after = around_section(readme)
    kept = readme.resolve().parent / picture.name
    if kept != picture.resolve():
        shutil.copyfile(picture, kept)
    middle = section(kept.name, machine, rows)
    with atomic_write(readme) as stream:
        stream.write(f"{before}{BEGIN}\n{middle}\n{END}{after}".encode())


def around_section(readme: Path) -> tuple[str, str]:
    """What stands before and after the section; to be asked before hours of measuring.

    Raises:
        InputError: the file or its markers are not there.
    """
    try:
        text = readme.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot read {readme}: {reason_of(error)}; give a Markdown file"
        ) from error
    before, begun, rest = text.partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not begun or not ended or text.count(BEGIN) != 1 or text.count(END) != 1:
        raise InputError(f"{readme} needs the lines '{BEGIN}' and '{END}' once each, in this order")
    return before, after


def section(picture: str, machine: dict[str, Any], rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: picture, table, how to read it, and what it ran on."""
    failed = [f"- {sentence}" for sentence in failures(rows)]
    parts = [
        f"![Run time per frame against trajectory error and against picture quality]({picture})",
        markdown(rows),
        " ".join((*features(rows), *NOTES)),
        "\n".join(failed),
        describe_machine(machine, rows),
    ]
    return "\n\n".join(part for part in parts if part)


def describe_machine(machine: dict[str, Any], rows: Sequence[dict[str, Any]]) -> str:
    """One paragraph on the machine, its load, the versions and the date."""
    loads = [row["load"] for row in rows if row["load"] is not None]
    busy = f" Load while it ran: {min(loads):.1f} to {max(loads):.1f}." if loads else ""
    gpu = f" GPU: {machine['gpu']}." if machine["gpu"] else ""
    packages = ", ".join(f"{name} {found}" for name, found in machine["packages"].items() if found)
    repeats = 1 + max(row["repeat"] for row in rows)
    times = "once" if repeats == 1 else f"{repeats} times, interleaved; medians ± half the range"
    return (
        f"Written by `aquaflow lab bench` on {machine['date']}; every run {times}. Machine: "
        f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB, "
        f"{machine['system']}.{gpu}{busy} AquaFlow {machine['aquaflow']}, Python "
        f"{machine['python']}, {packages}."
    )
