"""Tables: what a spreadsheet would run stands there as text, and reads back as it was."""

from __future__ import annotations

import csv
import io

import pytest

from aquaflow.base.storage.table import csv_text, text_of_cell

FORMULAS = [
    '=HYPERLINK("http://example.org","x").png',
    "+1+1.png",
    "-1+1.png",
    "@SUM(A1).png",
    "\t=1.png",
    "\n=1.png",
    "＝1.png",
    "a;=1.png",
    ";;=1;-cmd.png",
    "'=1.png",
    "''=1.png",
]


def cells_of(text: str, delimiter: str = ",") -> list[str]:
    return [cell for row in csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
            for cell in row]  # fmt: skip


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("delimiter", [",", ";"])
def test_no_cell_begins_as_a_formula_whatever_separates_cells(name: str, delimiter: str) -> None:
    for cell in cells_of(csv_text([["0", name, "0.5"]]), delimiter):
        assert not cell.startswith(tuple("=+-@\t\r\n＝＋－＠"))


@pytest.mark.parametrize("name", [*FORMULAS, "a.png", "'a'.png", "a-b=c;d.png", "", "'"])
def test_a_text_reads_back_as_it_was(name: str) -> None:
    (cell,) = cells_of(csv_text([[name]])) or [""]
    assert text_of_cell(cell) == name


@pytest.mark.parametrize("number", ["-0.25", "+3", "-1e-05", "-inf", "nan"])
def test_numbers_stay_numbers(number: str) -> None:
    assert csv_text([[number]]) == f"{number}\n"


def test_a_carriage_return_ends_no_row() -> None:
    assert cells_of(csv_text([["a\r=1\x1b[0m", "b"]])) == ["a\\r=1\\x1b[0m", "b"]
