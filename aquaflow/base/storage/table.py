"""Tables as CSV (RFC 4180) that a spreadsheet opens without running what stands in them.

A spreadsheet takes a cell that starts with ``=``, ``+``, ``-`` or ``@`` for a formula, and a
picture may be named ``=HYPERLINK(...)`` (OWASP, "CSV Injection"). Such a text gets an apostrophe
before it, also after a semicolon, which separates cells where the comma is the decimal sign;
numbers stay. Control characters become text, as ``printable_text`` has them.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from aquaflow.base.errors import DamagedError, InputError, printable_text, reason_of
from aquaflow.base.errors.regular_file import open_regular_text
from aquaflow.base.storage.atomic import atomic_write

Row = TypeVar("Row")

_FORMULA = r"(?='*[=+\-@\t\n＝＋－＠])"
"""What begins a formula, or another cell; a text with apostrophes of its own gets one more."""
_BEFORE = re.compile(r"(^|[;\t\n])" + _FORMULA)
_WRITTEN = re.compile(r"(^|[;\t\n])'" + _FORMULA)


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """The lines of a table, each ended by a line feed."""
    text = io.StringIO(newline="")
    lines = ([_harmless(str(cell)) for cell in row] for row in rows)
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def write_table(path: Path, rows: Iterable[Sequence[object]]) -> None:
    """Write the rows, the first of which is the header, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_write(path) as stream:
        stream.write(csv_text(rows).encode("utf-8"))


def read_table(
    path: Path, columns: Sequence[str], row_of: Callable[[dict[str, str]], Row]
) -> list[Row]:
    """What ``row_of`` makes of the cells of each row, by column, of a dive's table.

    Raises:
        InputError: it cannot be read, has other columns, or ``row_of`` raised ValueError.
    """
    try:
        with open_regular_text(path) as stream:
            header, *lines = csv.reader(stream)
        if tuple(header) != tuple(columns):
            raise DamagedError("its columns are others")
        return [row_of(dict(zip(columns, line, strict=True))) for line in lines]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error


def text_of_number(value: float, decimals: int) -> str:
    """The cell of a number, which has no sign where it is rounded to zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def text_of_cell(cell: str) -> str:
    """The text that :func:`csv_text` was given for a cell."""
    return _WRITTEN.sub(r"\1", cell)


def _harmless(cell: str) -> str:
    try:
        float(cell)
    except ValueError:
        return _BEFORE.sub(r"\1'", printable_text(cell))
    return cell
