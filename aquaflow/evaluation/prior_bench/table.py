"""The result of ``aquaflow prior bench`` on a terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

WORK = {"tracked": "near its prediction", "found": "moved far, none expected"}
"""What a pair of pictures asks of a prior."""


def print_result(result: dict[str, Any], console: Console) -> None:
    """One line for each row, then what the machine was."""
    table = Table(title="one frame, matching included")
    for column in ("prior", "weights", "threads", "size", "frame"):
        table.add_column(column)
    for column in ("ms", "ms of processor"):
        table.add_column(column, justify="right")
    for row in result["rows"]:
        size = f"{row['width']} x {row['height']}"
        names = (row["prior"], row["variant"], str(row["threads"]), size, WORK[row["work"]])
        table.add_row(*names, f"{row['ms']:.1f}", f"{row['cpu_ms']:.1f}")
    console.print(table)
    console.print(_recall_table(result["recall"]))
    machine = result["machine"]
    console.print(
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load']}",
        highlight=False,
    )


def _recall_table(recall: dict[str, dict[str, dict[str, float]]]) -> Table:
    table = Table(title="matches found within 2 px, pictures turned, moved and relit")
    table.add_column("prior")
    levels = list(next(iter(recall.values()), {}))
    for level in levels:
        table.add_column(level, justify="right")
    for name, by_level in recall.items():
        table.add_row(name, *(f"{by_level[level]['recall']:.3f}" for level in levels))
    return table
