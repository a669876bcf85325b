"""docs/formats.md: its tables are those of the classes that the files are written from."""

from __future__ import annotations

from tests.write_formats import BLOCK, PAGE, filled


def test_the_tables_of_the_file_formats_are_those_of_the_code() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert len(BLOCK.findall(page)) >= 6
    assert filled(page) == page, "run: python -m tests.write_formats"
