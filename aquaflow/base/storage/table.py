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
from collections.abc import Iterable, Sequence

from aquaflow.base.errors import printable_text

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


def text_of_cell(cell: str) -> str:
    """The text that :func:`csv_text` was given for a cell."""
    return _WRITTEN.sub(r"\1", cell)


def _harmless(cell: str) -> str:
    try:
        float(cell)
    except ValueError:
        return _BEFORE.sub(r"\1'", printable_text(cell))
    return cell
