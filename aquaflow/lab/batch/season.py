"""A batch: every job is done, once, whoever does it and whatever dies meanwhile."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.base.errors.regular_file import read_regular
from aquaflow.base.storage.atomic import is_cut_short, open_to_append
from aquaflow.lab.batch.job import WRITTEN, BatchOutcome, Job
from aquaflow.lab.batch.workers import Workers

LOOK_S = 0.5
"""s between looks at whether a Ctrl-C has come."""


class End(Enum):
    """Why a batch is over."""

    ALL = "every dive was tried"
    STOPPED = "stopped"
    FULL_DISK = "the disk is full"
    NO_WORKERS = "no one is left to make dives"


@dataclass
class Season:
    """What came of each dive."""

    outcomes: dict[str, BatchOutcome] = field(default_factory=dict)
    """By name; of a dive that was not tried to its end, none."""
    end: End = End.ALL
    reason: str = ""
    """Why no one is left."""


@dataclass
class _Queue:
    """Jobs that wait, and how often each was tried."""

    waiting: deque[Job]
    attempts: dict[str, int] = field(default_factory=dict)
    running: dict[str, Job] = field(default_factory=dict)


def run_season(
    jobs: Sequence[Job],
    workers: Workers,
    journal: Journal,
    retries: int,
    ended: Callable[[int, int], None],
) -> Season:
    """Do all ``jobs``; one whose process dies is tried ``retries`` times more.

    Long ones are begun first, so that none is left at the end alone. ``ended`` is told how many
    have ended, of how many. After a full disk nothing more is begun. Ctrl-C stops what runs.
    """
    longest_first = sorted(jobs, key=lambda job: (-job.size_bytes, job.name))
    queue, season = _Queue(deque(longest_first)), Season()
    try:
        while queue.waiting or queue.running:
            _start(queue, workers, journal)
            found = workers.wait(LOOK_S)
            if found is None:
                continue
            _settle(*found, queue, season, journal, retries)
            ended(len(season.outcomes), len(jobs))
    except KeyboardInterrupt:
        season.end = End.STOPPED
    except AquaFlowError as error:
        season.end, season.reason = End.NO_WORKERS, str(error)
    finally:
        workers.close()
    journal.write("ended", reason=season.reason or season.end.value)
    return season


def _start(queue: _Queue, workers: Workers, journal: Journal) -> None:
    """Begin every waiting job that has room now."""
    for job in list(queue.waiting):
        if workers.takes(job):
            queue.waiting.remove(job)
            queue.running[job.name] = job
            queue.attempts[job.name] = attempt = queue.attempts.get(job.name, 0) + 1
            journal.write("started", job.name, attempt=attempt, memory_mb=job.memory_mb)
            workers.start(job)


def _settle(
    name: str, outcome: BatchOutcome, queue: _Queue, season: Season, journal: Journal, retries: int
) -> None:
    """Note what came of an attempt; what was lost waits again, unless it was tried often enough."""
    job = queue.running.pop(name)
    again = outcome.state == "lost" and queue.attempts[name] <= retries
    event = "lost" if again else outcome.state
    journal.write(event, name, attempt=queue.attempts[name], outcome=outcome.to_json())
    if again:
        queue.waiting.append(job)
        return
    if outcome.state == "full":
        queue.waiting.clear()
        season.end = End.FULL_DISK
    season.outcomes[name] = outcome


def failed_jobs(season: Season, jobs: Sequence[Job]) -> list[Job]:
    """Jobs that were not done."""
    outcomes = season.outcomes
    return [j for j in jobs if j.name not in outcomes or outcomes[j.name].state not in WRITTEN]


# --------------------------------------------------------------------------------------------------
# ``batch.jsonl``: what happened to each dive of a season, one line each, appended to for ever.

JOURNAL = "batch.jsonl"


class Journal:
    """Lines that are on the disk when :meth:`write` returns."""

    def __init__(self, path: Path) -> None:
        """Open the journal; half a line, which a kill or a full disk left, is removed.

        Raises:
            InputError: it cannot be written.
        """
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _mend(path)
            self._stream = open_to_append(path).detach()  # unbuffered
        except OSError as error:
            raise InputError(
                f"cannot write {path}: {error.strerror}; give another --out"
            ) from error

    def write(self, event: str, dive: str | None = None, **more: Any) -> None:
        """Append a line. A disk that takes none costs that line: a dive's own manifest, not the
        journal, says that it is there."""
        now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        line = {"t": now, "event": event} | ({} if dive is None else {"dive": dive}) | more
        with contextlib.suppress(OSError):
            if is_cut_short(self.path):
                _mend(self.path)
            self._stream.write(json.dumps(line).encode() + b"\n")
            os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Release the file."""
        self._stream.close()


def _mend(path: Path) -> None:
    """Cut off a last line that has no end."""
    if is_cut_short(path):
        text = read_regular(path)
        os.truncate(path, text.rfind(b"\n") + 1)
