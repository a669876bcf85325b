"""A frames.csv that was damaged: what is wrong costs its line, and no other."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.dive.frames_csv import FrameRow, header, read_rows, readable_rows, to_text

ROWS = [
    FrameRow(0, "film#0", 0.0, "keyframe", 0, 0, 1.0),
    FrameRow(1, "film#1", 0.1, "dropped", reason='failed: "no"\nsecond line, with, commas'),
    FrameRow(2, "film#2", 0.2, "common", 0, 0, 0.987),
    FrameRow(3, "film#3", 0.3, "skipped", reason="too dark"),
]


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "frames.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_an_undamaged_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = written(tmp_path, header() + to_text(ROWS))
    assert readable_rows(path) == (ROWS, 0)
    assert read_rows(path) == ROWS


@pytest.mark.parametrize(
    ("line", "damaged"),
    [
        (b'9,"film#9,0.9,common,0,0,0.9,\n', 1),  # a quotation mark that was none
        (b"9,film\xff9,0.9,common,0,0,0.9,\n", 1),
        (b"9,film#9,0.9,common,0,0\n", 1),
        (b"9,film#9,zero,common,0,0,0.900,\n", 1),
        (b"1_2,film#9,0.900000000,common,0,0,0.900,\n", 1),  # for int() a number
        (b"\x00\n\n", 2),
        (b"x" * 200_000 + b"\n", 1),
    ],
)
def test_a_damaged_line_costs_itself(tmp_path: Path, line: bytes, damaged: int) -> None:
    before, after = (to_text(rows).encode() for rows in (ROWS[:2], ROWS[2:]))
    path = written(tmp_path, header().encode() + before + line + after)
    assert readable_rows(path) == (ROWS, damaged)


def test_a_last_line_that_was_cut_and_a_damaged_heading_are_counted(tmp_path: Path) -> None:
    text = (header() + to_text(ROWS)).replace("index", "jndex")[:-3]
    assert readable_rows(written(tmp_path, text)) == (ROWS[:-1], 2)
