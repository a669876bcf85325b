"""The rows of frames.csv: the result of each frame."""

from __future__ import annotations

import csv
import io
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import open_regular_text, read_regular
from aquaflow.base.storage.table import csv_text, text_of_cell

MOST_LINES = 20
"""Lines of one reason; a library's message has a few."""

FRAME_COLUMNS = ("index", "source", "t_s", "class", "sub_map", "keyframe", "quality", "reason")
"""Columns of frames.csv, as the fields of :class:`FrameRow`."""


@dataclass(frozen=True)
class FrameRow:
    """One line of frames.csv."""

    index: int
    """Position in the recording, counted before any sub-sampling."""
    source: str
    r"""File name of the picture, ``clip.mp4#123``, or ``camera#123``; control characters as
    ``\x1b``."""
    t_s: float
    """Seconds since the recording's first frame."""
    frame_class: str
    """``keyframe``, ``mapping``, ``common``, ``skipped``, ``lost`` or ``dropped``."""
    sub_map: int | None = None
    """Number of the sub-map; none without a pose."""
    keyframe: int | None = None
    """Number of the keyframe that the pose refers to; none without a pose."""
    quality: float | None = None
    """Share of the matches that agree with the pose."""
    reason: str = ""
    """Why the frame was skipped, lost or dropped; else empty."""

    @staticmethod
    def of_cells(cells: Sequence[str]) -> FrameRow:
        """The row of a line of the file."""
        index, source, t_s, frame_class, sub_map, keyframe, quality, reason = map(
            text_of_cell, cells
        )
        return FrameRow(
            int(index), source, float(t_s), frame_class,
            int(sub_map) if sub_map else None,
            int(keyframe) if keyframe else None,
            float(quality) if quality else None,
            reason,
        )  # fmt: skip

    def cells(self) -> list[str]:
        quality = "" if self.quality is None else f"{self.quality:.3f}"
        sub_map = "" if self.sub_map is None else str(self.sub_map)
        keyframe = "" if self.keyframe is None else str(self.keyframe)
        return [
            str(self.index), self.source, f"{self.t_s:.9f}", self.frame_class,
            sub_map, keyframe, quality, self.reason,
        ]  # fmt: skip


def to_text(rows: Iterable[FrameRow]) -> str:
    """Their lines of frames.csv."""
    return csv_text(row.cells() for row in rows)


def header() -> str:
    """The first line of frames.csv."""
    return csv_text([FRAME_COLUMNS])


def of_text(text: str) -> list[FrameRow]:
    """The rows of :func:`to_text`; a last one that was cut short is left out.

    Raises:
        ValueError: these are no rows.
    """
    lines = csv.reader(io.StringIO(text, newline=""))
    return [FrameRow.of_cells(cells) for cells in lines if len(cells) == len(FRAME_COLUMNS)]


def read_rows(path: Path) -> list[FrameRow]:
    """The rows of frames.csv; a last one that was cut short is left out.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with open_regular_text(path) as stream:
            next(stream, None)
            return of_text(stream.read())
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error


def readable_rows(path: Path) -> tuple[list[FrameRow], int]:
    """The rows of a frames.csv that may be damaged, and the number of lines that are none.

    Raises:
        FileNotFoundError, OSError: there is no such file, or it cannot be read at all.
    """
    lines = read_regular(path).splitlines(keepends=True)
    damaged = 0 if lines[:1] == [header().encode("utf-8")] else 1
    rows = []
    for line in _join(lines[1:]):
        row = _row_of(line)
        if row is None:
            damaged += 1
        else:
            rows.append(row)
    return rows, damaged


def _join(lines: Sequence[bytes]) -> Iterator[bytes]:
    """Lines of the file as lines of the table: a reason in quotation marks may have several."""
    waiting: list[bytes] = []
    for line in lines:
        whole = b"".join([*waiting, line])
        if whole.count(b'"') % 2 and _row_of(line) is None and len(waiting) < MOST_LINES:
            waiting.append(line)
            continue
        if waiting and _row_of(whole) is None:  # the mark was damage, and what follows is not
            yield from [*waiting, line]
        else:
            yield whole
        waiting = []
    yield from waiting


def _row_of(line: bytes) -> FrameRow | None:
    """The row that was written as just this line."""
    try:
        text = line.decode("utf-8")
        [row] = of_text(text)
        return row if to_text([row]) == text else None
    except (ValueError, csv.Error):
        return None


def or_lost(row: FrameRow, known: Container[int]) -> FrameRow:
    """The row, or that the frame was lost in a restart if its index is not ``known``."""
    if row.index in known or row.frame_class == "dropped":
        return row
    return FrameRow(row.index, row.source, row.t_s, "dropped", reason="lost in a restart")
