"""docs/formats.md: its tables are those of the classes that the files are written from."""

from __future__ import annotations

import re

from aquaflow.dive.folder import RESULTS
from tests.write_formats import BLOCK, PAGE, filled


def test_the_tables_of_the_file_formats_are_those_of_the_code() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert len(BLOCK.findall(page)) >= 6
    assert filled(page) == page, "run: python -m tests.write_formats"


def test_every_file_that_a_dive_may_hold_is_on_the_page() -> None:
    page = PAGE.read_text(encoding="utf-8")
    names = re.findall(r"`([^`\n]+)`", page)
    missing = []
    for pattern in RESULTS:
        folders = {name.rstrip("/") for name in names if name.endswith("/")}
        named = re.compile(re.escape(pattern).replace(r"\*", ".*"))
        if pattern.split("/")[0] not in folders and not any(map(named.fullmatch, names)):
            missing.append(pattern)
    assert missing == []
