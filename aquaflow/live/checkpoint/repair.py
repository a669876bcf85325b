"""Salvage of a dive before it is resumed: damaged files are set aside, losses are reported.

Every file of ``work/`` has a checksum of its own. A keyframe without its file
keeps its pose, and so do the frames relative to it; a view without its file leaves the map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.base.storage.spill import SUFFIX, read_item
from aquaflow.base.storage.whole_folder import refuse_held
from aquaflow.config import Config
from aquaflow.dive.folder import MARKER, WORK
from aquaflow.dive.frames_csv import FrameRow, or_lost, readable_rows
from aquaflow.dive.run import DiveRun
from aquaflow.geometry.arrays import to_camera
from aquaflow.live.checkpoint.generations import (
    Checkpoint,
    OtherFormatError,
    SetAside,
    previous_file,
    read_state,
    state_file,
)
from aquaflow.live.checkpoint.resume import Choice
from aquaflow.live.checkpoint.tracking import lost_since, refuse_another_size
from aquaflow.live.clock_reading import ClockReading
from aquaflow.mapping.work import OwnedMaps
from aquaflow.recordings.telemetry_lines import NAME, TelemetryLines, to_line
from aquaflow.slam import Slam
from aquaflow.tracking.frame_table import FrameTable

MOST_NAMED = 5
"""Numbers that a sentence lists."""


@dataclass(frozen=True)
class RepairedDive:
    """The rows that a resumed dive continues, and what was lost."""

    rows: list[FrameRow]
    losses: list[str]
    """A sentence for each loss that the checkpoint's own files and the rows show."""


def repair_dive(checkpoint: Checkpoint, dive: Path, name_of: Callable[[int], str]) -> RepairedDive:
    """Prepare ``dive`` for resuming from ``checkpoint``; ``name_of`` gives a frame index's name.

    Raises:
        InputError: a damaged file cannot be set aside.
    """
    aside, losses = SetAside(dive), []
    rows = salvaged_rows(dive / MARKER, checkpoint, name_of)
    older = checkpoint.file != state_file(dive)
    if older or not rows.whole:
        for name in (MARKER, "trajectory.tum"):
            aside.copy(dive / name, "as it was before the dive was resumed")
    if older:
        losses.append(_newest_set_aside(dive, aside))
    elif previous_file(dive).is_file() and not _is_whole(previous_file(dive)):
        aside.move(previous_file(dive), "it is damaged")
        losses.append("the checkpoint before the newest one was damaged, which the dive can spare")
    for path in sorted((dive / WORK).glob(f"*/*{SUFFIX}")):
        _look_at(path, checkpoint.keyframes if older else None, aside)
    known = checkpoint.frames
    cut_at_checkpoint(dive, checkpoint.moment, ClockReading.now(), aside)
    after = [or_lost(row, known) for row in rows.rows]
    return RepairedDive(after, losses + _row_losses(rows, dive / MARKER))


def salvaged_from(
    choice: Choice, config: Config, name_of: Callable[[int], str]
) -> RepairedDive | None:
    """The dive that goes on in the chosen folder; None for a new one.

    Raises:
        ConfigError: it is of pictures of another size.
        InputError: another process writes to it, or a damaged file cannot be set aside.
    """
    if choice.checkpoint is None:
        return None
    refuse_another_size(choice.folder, choice.checkpoint.facts["tracking"], config)
    refuse_held(choice.folder)
    return repair_dive(choice.checkpoint, choice.folder, name_of)


def lost_with_their_files(checkpoint: Checkpoint, slam: Slam, maps: OwnedMaps) -> list[str]:
    """A sentence for keyframes, and one for views, whose files were missing when ``slam`` and
    ``maps`` were restored."""
    said = []
    keyframes = lost_since(slam, checkpoint.facts["tracking"])
    if keyframes:
        hang = sum(tracked.keyframe in keyframes for tracked in slam.results())
        said.append(
            f"the files of {_name_lost('keyframe', keyframes)} were damaged or gone: their {hang} "
            "frames keep their poses, but these places are no longer recognised"
        )
    lost = maps.lost_pictures
    if lost:
        said.append(
            f"the pictures of {_name_lost('mapped frame', lost)} were damaged or gone: the "
            "map goes on without them"
        )
    return said


def _newest_set_aside(dive: Path, aside: SetAside) -> str:
    if state_file(dive).is_file():
        aside.move(state_file(dive), "it is damaged, or another version's")
    return (
        "the newest checkpoint was damaged or gone: the dive was resumed from the one before, and "
        "frames that came between the two have no pose"
    )


def _look_at(path: Path, keyframes: int | None, aside: SetAside) -> None:
    """Set a file of ``work/`` aside if it is damaged, or would be overwritten: with an older
    checkpoint, the keyframes that it does not contain."""
    try:
        read_item(path)
    except InputError:
        aside.move(path, "it is damaged, or not the one that it is named after")
        return
    if keyframes is not None and path.parent.name == "keyframes" and int(path.stem) >= keyframes:
        aside.move(path, "it is whole, but the newest checkpoint, which knew it, is damaged")


def _is_whole(path: Path) -> bool:
    try:
        read_state(path)
    except OtherFormatError:
        return True
    except InputError:
        return False
    return True


def _row_losses(rows: RepairedRows, path: Path) -> list[str]:
    if not path.is_file():
        return [
            f"{MARKER} was gone: {rows.rebuilt} rows were made from the checkpoint, those of "
            "frames that were left out, and all reasons, are lost"
        ]
    if rows.whole:
        return []
    return [
        f"{rows.unreadable} lines of {MARKER} were damaged, and {rows.rebuilt} rows were made from "
        "the checkpoint"
    ]


def _name_lost(kind: str, numbers: Iterable[int]) -> str:
    ordered = sorted(numbers)
    listed = ", ".join(map(str, ordered[:MOST_NAMED]))
    more = "" if len(ordered) <= MOST_NAMED else f" and {len(ordered) - MOST_NAMED} more"
    return f"{kind}{'' if len(ordered) == 1 else 's'} {listed}{more}"


# --------------------------------------------------------------------------------------------------
# The rows of a frames.csv that may be damaged, with the help of the checkpoint: it knows what
# became of every frame until it was taken, though not the reasons.


@dataclass(frozen=True)
class RepairedRows:
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
) -> RepairedRows:
    """The rows of ``path``, those that the checkpoint knows better from there; ``name_of`` a
    frame's index: its file, or where it is in the film."""
    try:
        found, unreadable = readable_rows(path)
    except OSError:
        found, unreadable = [], 0
    known = {row.index: row for row in _known_rows(checkpoint, name_of)}
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
    return RepairedRows(rows + missing, unreadable, rebuilt + len(missing))


def _agree(row: FrameRow, true: FrameRow) -> bool:
    """Sub-maps may have become one since."""
    return replace(row, sub_map=None).cells()[2:7] == replace(true, sub_map=None).cells()[2:7]


def _known_rows(checkpoint: Checkpoint, name_of: Callable[[int], str]) -> list[FrameRow]:
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


# --------------------------------------------------------------------------------------------------
# The telemetry of a dive before its resumption: read back from telemetry.jsonl.


def cut_at_checkpoint(dive: Path, taken: ClockReading, now: ClockReading, aside: SetAside) -> None:
    """Take the samples of after the checkpoint out of the dive's telemetry, if the machine was
    started anew: without a clock that runs on, the dive's time of now may be theirs.

    Raises:
        InputError: the file cannot be read, or set aside.
    """
    path = dive / NAME
    if taken.is_of_the_boot_of(now) or not path.is_file():
        return
    try:
        if not any(sample.arrival_ns > taken.dive_ns for sample in TelemetryLines(path).samples()):
            return
        aside.copy(path, "samples of after the checkpoint, before the machine was started anew")
        with atomic_write(path) as stream:
            for sample in TelemetryLines(path).samples():
                if sample.arrival_ns <= taken.dive_ns:
                    stream.write(to_line(sample))
    except OSError as error:
        raise InputError(f"cannot resume with {path}: {error.strerror}") from error


def hear_again(run: DiveRun) -> None:
    """Give ``run``, whose tracking was restored, the telemetry of before, and the sub-maps the
    metric frames that follow from it; damaged lines cost themselves."""
    lines, metric = TelemetryLines(run.folder.path / NAME), run.slam.metric
    with run.slam.failures.contain("reading back of telemetry"):
        if lines.path.is_file():
            for sample in lines.samples():
                run.sample(sample)
    if lines.damaged:
        run.notes.append(f"{lines.damaged} damaged lines of {NAME} were left out")
    if metric.present:
        metric.resume(run.slam.graph.snapshot)
