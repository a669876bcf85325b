"""``reef_numbers.json`` and ``reef_numbers.csv``."""

from __future__ import annotations

from pathlib import Path

from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.base.storage.spill import csv_text
from aquaflow.survey.measure.reef_numbers import ReefNumbers

JSON, CSV = "reef_numbers.json", "reef_numbers.csv"
"""In the dive folder."""


def write_reef_numbers(folder: Path, found: ReefNumbers) -> None:
    """Write both files.

    Raises:
        InputError: a file cannot be written.
    """
    write_json(folder / JSON, found.to_json())
    write_csv(folder / CSV, found.rows())


def write_csv(path: Path, rows: list[list[str]]) -> None:
    """Write a table with its head.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_write(path) as stream:
        stream.write(csv_text(rows).encode("utf-8"))
