"""A killed dive, what may happen to its files, and what is left after it was gone on with."""

from __future__ import annotations

import random
import shutil
import sys
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from html import unescape
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.base.storage.spill import read_item
from aquaflow.dive.frames_csv import FrameRow, readable_rows
from aquaflow.dive.run import Finished
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.live.checkpoint.generations import STATE, Checkpoint
from aquaflow.live.checkpoint.resume import newest_usable
from aquaflow.live.clock_reading import Continued
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.onboard import OnboardSettings, begin_dive
from aquaflow.sources import open_recording
from aquaflow.sources.newest import Newest
from aquaflow.types import Dropped, Frame
from tests.live.live_scenes import VEHICLE, ToldFeed, caught_up

PICTURES = SyntheticConfig(frames=26, width=96, height=72)
STOPPED, FIRST, SECOND, KILLED = 11, 16, 20, 23
"""Frames until the dive was told to stop for the first time, until the last two checkpoints that
its second run took, and until that run was killed."""
KINDS = ("flip", "cut", "delete", "swap")


class OneByOne(Newest[Frame | Dropped]):
    """Gives each frame when it is asked for the next; then calls ``at_end``."""

    def __init__(self, frames: list[Frame]) -> None:
        super().__init__()
        self.frames = deque(frames)
        self.at_end: Callable[[], object] = lambda: None

    def take(self, timeout_s: float | None = None) -> Frame | Dropped | None:
        if self.frames:
            return self.frames.popleft()
        self.at_end()
        return None


class ListedFeed(ToldFeed):
    """The frames of a recording that no run saw yet, without a clock."""

    def __init__(self, frames: list[Frame]) -> None:
        super().__init__()
        self.listed = OneByOne(frames)
        self.newest = self.listed

    def continue_from(self, continued: Continued) -> None:
        super().continue_from(continued)
        seen = continued.first_index
        self.listed.frames = deque(frame for frame in self.listed.frames if frame.index >= seen)


def frames_of(recording: Path) -> list[Frame]:
    return [frame for frame in open_recording(recording).frames() if isinstance(frame, Frame)]


def gone_on_with(folder: Path, frames: list[Frame], new: bool = False) -> tuple[Finished, bool]:
    """Resume, take the frames, and be told to stop, which keeps what it can be resumed from; and
    True if it was the dive of before."""
    feed = ListedFeed(frames)
    with begin_dive(feed, VEHICLE, OnboardSettings(folder, new)) as dive:
        feed.listed.at_end = partial(_stop, dive)
        finished = dive.run()
    assert finished is not None
    return finished, dive.parts.choice.checkpoint is not None


def _stop(dive: LiveDive) -> None:
    caught_up(dive)
    dive.control.stopping.set()


def killed_dive(folder: Path) -> list[Frame]:
    """Write ``folder / "dive"``, which was told to stop once, resumed and then killed; its
    recording's frames."""
    write_dive(folder / "recording", PICTURES)
    frames = frames_of(folder / "recording")
    gone_on_with(folder / "running", frames[:STOPPED])
    feed = ListedFeed([])
    with begin_dive(feed, VEHICLE, OnboardSettings(folder / "running")) as dive:
        for count, frame in enumerate(frames[STOPPED:KILLED], start=STOPPED + 1):
            dive.parts.loop.take(frame)
            if count in (FIRST, SECOND):
                caught_up(dive)
                dive.parts.checkpointer.take()
                caught_up(dive)
        caught_up(dive)
        shutil.copytree(folder / "running", folder / "dive")  # as a kill leaves it
    return frames


# --- damage ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Damage:
    """What happened to which files, named from the dive's folder."""

    kind: str
    files: tuple[str, ...]


def damaged(dive: Path, rng: random.Random) -> Damage:
    """Damage a random file of the dive."""
    files = sorted(path for path in dive.rglob("*") if path.is_file() and path.stat().st_size)
    kind, path = rng.choice(KINDS), rng.choice(files)
    touched = [path]
    if kind == "delete":
        path.unlink()
    elif kind == "swap":
        touched.append(rng.choice([each for each in files if each != path]))
        spare = dive / "spare"
        path.rename(spare)
        touched[1].rename(path)
        spare.rename(touched[1])
    else:
        data = bytearray(path.read_bytes())
        at = rng.randrange(len(data))
        if kind == "flip":
            data[at] ^= 1 << rng.randrange(8)
        else:
            del data[at:]
        path.write_bytes(data)
    return Damage(kind, tuple(str(each.relative_to(dive)) for each in touched))


# --- what can be read -----------------------------------------------------------------------------


@dataclass
class Readable:
    """What of a dive can be read, by its name there or in a folder of what was set aside."""

    rows: dict[int, FrameRow] = field(default_factory=dict)
    kept_rows: list[FrameRow] = field(default_factory=list)
    """Of the copies of frames.csv that were set aside."""
    things: set[str] = field(default_factory=set)
    """Files of keyframes and views."""
    trajectory: set[str] = field(default_factory=set)
    """Times of the posed frames."""


def readable(dive: Path) -> Readable:
    found = Readable()
    for part in (dive, *dive.glob("set-aside-*")):
        if (part / "frames.csv").is_file():
            rows, _ = readable_rows(part / "frames.csv")
            found.kept_rows += rows
            if part == dive:
                found.rows = {row.index: row for row in rows}
        for path in part.glob("work/*/*.arrays"):
            try:
                read_item(path)
            except InputError:
                continue
            found.things.add(f"{path.parent.name}/{path.name}")
        found.trajectory |= _times(part / "trajectory.tum")
    return found


def _times(path: Path) -> set[str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return set()
    return {line.split()[0] for line in lines if len(line.split()) == 8 and line[0] != "#"}


@dataclass
class Outcome:
    """What became of a damaged dive."""

    damage: Damage
    went_on: str = ""
    """From the newest checkpoint, or from the one before, or a new dive beside."""
    said: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def outcome(killed: Path, folder: Path, frames: list[Frame], rng: random.Random) -> Outcome:
    """Damage a copy of the ``killed`` dive in ``folder``, go on with it, look at what is left."""
    dive = folder / "dive"
    shutil.copytree(killed, dive)
    whole = readable(killed)
    found = Outcome(damaged(dive, rng))
    before = readable(dive)
    known = newest_usable(dive)
    assert known is not None
    finished, resumed = gone_on_with(dive, frames)
    found.said = [note for note in finished.notes if "focal length" not in note]
    found.went_on = known.file.stem if resumed and finished.dive == dive else "beside"
    after = readable(dive)
    found.problems += _rows_gone(whole, before, after, known.frames)
    found.problems += [f"{name} is gone" for name in (before.things & whole.things) - after.things]
    gone = (before.trajectory & whole.trajectory) - after.trajectory
    found.problems += [f"the pose at {t} s is gone" for t in gone]
    posed = int((known.arrays["tracking.frames"]["keyframe"] >= 0).sum())
    if finished.metrics["tracked"] < posed:
        found.problems.append(f"{finished.metrics['tracked']} poses of {posed} that were known")
    costly = {f"checkpoint/{STATE}", *_named(known)} & {*found.damage.files}
    if (costly or len(before.rows) < len(whole.rows)) and not found.said:
        found.problems.append(f"nobody said that {costly or 'rows'} were lost")
    found.problems += _unsaid(found.said, dive)
    return found


def _named(known: Checkpoint) -> set[str]:
    """The files of ``work/`` that the checkpoint cannot do without."""
    arrays = known.arrays.items()
    views = [rows for name, rows in arrays if name.endswith("views.numbers") or "held_out" in name]
    numbered = {int(i) for rows in views if rows.dtype == np.int64 for i in rows[:, 0]}
    files = {f"work/views/{index:06d}.arrays" for index in numbered}
    return files | {f"work/keyframes/{number:06d}.arrays" for number in range(known.keyframes)}


def _rows_gone(whole: Readable, before: Readable, after: Readable, known: set[int]) -> list[str]:
    problems = []
    for index, row in before.rows.items():
        if row != whole.rows.get(index):
            continue  # it was damaged
        now = after.rows.get(index)
        lost = now is not None and now.reason == "lost in a restart"
        if now is None or (now.index, now.source, now.t_s) != (row.index, row.source, row.t_s):
            problems.append(f"row {index} is gone")
        elif not lost and (now.frame_class, now.keyframe) != (row.frame_class, row.keyframe):
            problems.append(f"row {index} changed: {row} {now}")
        elif lost and index in known and row.frame_class != "dropped":
            problems.append(f"row {index} was known and is lost")
    return problems


def _unsaid(notes: list[str], dive: Path) -> list[str]:
    """Notes that stand not in the report, or not in the log."""
    report, log = (
        (dive / name).read_text(encoding="utf-8", errors="replace")
        for name in ("report.html", "log.jsonl")
    )
    return [
        f"not in {name}: {note}"
        for note in notes
        for name, text in (("report", unescape(report)), ("log", log))
        if note not in text
    ]


def many(killed: Path, frames: list[Frame], count: int, seed: int) -> list[Outcome]:
    """So many damages, one after the other."""
    outcomes = []
    for i in range(count):
        with TemporaryDirectory() as folder:
            outcomes.append(outcome(killed, Path(folder), frames, random.Random(f"{seed} {i}")))
    return outcomes


if __name__ == "__main__":  # python -m tests.live.damaged_dives COUNT [SEED]: the figures
    with TemporaryDirectory() as work:
        seen = killed_dive(Path(work))
        results = many(Path(work) / "dive", seen, int(sys.argv[1]), int((*sys.argv, "0")[2]))
    table = Counter((each.damage.kind, each.went_on, bool(each.said)) for each in results)
    for key in sorted(table):
        print(*key, table[key])
    for each in results:
        if each.problems:
            print(each.damage, each.went_on, each.said, each.problems)
