"""The rows of a frames.csv that may be damaged, with the help of the checkpoint: it knows what
became of every frame until it was taken, though not the reasons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from aquaflow.dive.frames_csv import FrameRow, readable_rows
from aquaflow.geometry.arrays import to_camera
from aquaflow.live.checkpoint.generations import Checkpoint
from aquaflow.tracking.frame_table import FrameTable


@dataclass(frozen=True)
class SalvagedRows:
    """The rows salvaged from a frames.csv."""

    rows: list[FrameRow]
    unreadable: int = 0
    """Lines that cannot be parsed or hold impossible values."""
    rebuilt: int = 0
    """Rows that were made from the checkpoint."""

    @property
    def whole(self) -> bool:
        """True if nothing was damaged."""
        return not self.unreadable and not self.rebuilt


def salvaged_rows(
    path: Path, checkpoint: Checkpoint, name_of: Callable[[int], str]
) -> SalvagedRows:
    """The rows of ``path``, those that the checkpoint knows better from there; ``name_of`` a
    frame's index: its file, or where it is in the film."""
    try:
        found, unreadable = readable_rows(path)
    except OSError:
        found, unreadable = [], 0
    known = {row.index: row for row in _known(checkpoint, name_of)}
    newest = max(known, default=-1)
    named = any(row.index == newest and row.source == known[newest].source for row in found)
    rows: list[FrameRow] = []
    rebuilt = 0
    for row in found:
        true = known.get(row.index)
        if true is None and row.index > newest and named and row.source != _name(name_of, row):
            unreadable += 1  # the next frame would be looked for behind it
        elif true is None or row.frame_class == "dropped" or _agree(row, true):
            rows.append(row)
        else:
            rows.append(replace(true, source=row.source, reason=row.reason))
            rebuilt += 1
    there = {row.index for row in rows if row.frame_class != "dropped"}
    missing = [row for index, row in known.items() if index not in there]
    return SalvagedRows(rows + missing, unreadable, rebuilt + len(missing))


def _agree(row: FrameRow, true: FrameRow) -> bool:
    """Sub-maps may have become one since."""
    return replace(row, sub_map=None).cells()[2:7] == replace(true, sub_map=None).cells()[2:7]


def _known(checkpoint: Checkpoint, name_of: Callable[[int], str]) -> list[FrameRow]:
    """Rows of the frames that the checkpoint knows."""
    camera = to_camera(checkpoint.facts["tracking"]["camera"])
    rows = []
    for tracked, T_kf in FrameTable.of_rows(checkpoint.arrays["tracking.frames"], camera):
        row = FrameRow(
            tracked.frame.index, "", tracked.frame.t_ns * 1e-9, tracked.frame_class.value
        )
        if T_kf is not None:
            row = replace(
                row, sub_map=tracked.sub_map, keyframe=tracked.keyframe,
                quality=tracked.quality.inlier_share,
            )  # fmt: skip
        rows.append(replace(row, source=_name(name_of, row)))
    return rows


def _name(name_of: Callable[[int], str], row: FrameRow) -> str:
    try:
        return name_of(row.index)
    except LookupError:  # a folder has no such picture
        return ""
