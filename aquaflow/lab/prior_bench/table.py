"""The results of ``aquaflow lab prior bench`` and ``prior compare`` on a terminal."""

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


COMPARED = (
    ("recall", "recall", ".3f"),
    ("precision", "within 2 px", ".3f"),
    ("median_px", "median px", ".2f"),
    ("matches", "matches", "d"),
    ("rotation_deg", "rotation °", ".2f"),
    ("direction_deg", "direction °", ".1f"),
    ("picture_cpu_ms", "ms/picture", ".0f"),
    ("pair_cpu_ms", "ms/pair", ".0f"),
)
"""Key, title and format of the columns of a comparison."""
COMPARISON_NOTES = (
    "recall: textured pixels that b shows and that are matched within 2 px, of dense methods; "
    "within 2 px: of the matches, from the true place, or * from the true epipolar line, where a "
    "wrong match may lie by chance; rotation and direction: error of the pose from the matches.",
    "Times are of the processor. A network looks at a picture once, SIFT only where flow fails, "
    "then in the pair's time.",
)
"""What the titles leave open."""


def print_comparison(result: dict[str, Any], console: Console) -> None:
    """One line for each method on each kind of pairs, and what could not run."""
    table = Table(title="the same pairs, nothing predicted")
    for column in ("pairs", "method"):
        table.add_column(column)
    for _, title, _ in COMPARED:
        table.add_column(title, justify="right")
    before = None
    for row in result["rows"]:
        if before not in (None, row["pairs"]):
            table.add_section()
        name = "" if row["pairs"] == before else f"{row['pairs']} ({row['count']})"
        before = row["pairs"]
        cells = (_cell(row, key, form) for key, _, form in COMPARED)
        table.add_row(name, row["method"], *cells)
    console.print(table)
    for sentence in (*result["missing"], *COMPARISON_NOTES):
        console.print(sentence, highlight=False, markup=False)


def _cell(row: dict[str, Any], key: str, form: str) -> str:
    if row[key] is None:
        return "-"
    by_line = row["judged_by"] == "line" and key in ("precision", "median_px")
    return format(row[key], form) + ("*" if by_line else "")
