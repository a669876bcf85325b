"""log.jsonl: what happened in a dive, for programs to read."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import re
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, TextIO, TypeAlias

from aquaflow.base.storage.atomic import is_cut_short, open_to_append

LOGGERS = ("aquaflow", "py.warnings")
"""Loggers whose records go to log.jsonl."""
MOST_EARLY = 1000
"""Records of before a dive that are kept for its log; the oldest go first."""

_FORMATTER = logging.Formatter()
"""Writes tracebacks, and nothing else."""


class EarlyRecords(logging.Handler):
    """What is logged before a dive has a folder: the next dive's log takes it."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._records: deque[logging.LogRecord] = deque(maxlen=MOST_EARLY)
        self._logger = logging.getLogger(LOGGERS[0])
        self._level_before = self._logger.level

    def attach(self) -> None:
        """Keep what AquaFlow logs from here on, unless another already does."""
        if not _early():
            self._logger.setLevel(logging.INFO)
            self._logger.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        self._records.append(record)

    def take(self) -> list[logging.LogRecord]:
        """End, and the records."""
        self._logger.removeHandler(self)
        self._logger.setLevel(self._level_before)
        return list(self._records)


def _early() -> list[EarlyRecords]:
    handlers = logging.getLogger(LOGGERS[0]).handlers
    return [handler for handler in handlers if isinstance(handler, EarlyRecords)]


def _open_log(path: Path, append: bool) -> TextIO:
    if not append:
        path.unlink(missing_ok=True)
    return io.TextIOWrapper(open_to_append(path), encoding="utf-8")


class JsonLog(logging.Handler):
    """One JSON object a line, flushed at once; a record's ``fields`` become keys of their own.

    What repeats is counted: see :mod:`aquaflow.dive.log`.
    """

    def __init__(
        self,
        path: Path,
        append: bool = False,
        dive_s: Callable[[], float | None] = lambda: None,
    ) -> None:
        """``dive_s``: seconds since the dive's first frame; None before it, and in a replay."""
        super().__init__(logging.INFO)
        cut_short = append and is_cut_short(path)
        self._stream = _open_log(path, append)
        if cut_short:  # what follows begins a line of its own
            self._stream.write("\n")
        self._levels_before: dict[str, int] = {}
        self._dive_s, self._repeats = dive_s, Repeats()

    def attach(self) -> None:
        """Receive what AquaFlow logs from here on, until closed, and what was kept for it."""
        early = [record for each in _early() for record in each.take()]
        for name in LOGGERS:
            logger = logging.getLogger(name)
            self._levels_before[name] = logger.level
            logger.setLevel(logging.INFO)
            logger.addHandler(self)
        for record in early:
            self.handle(record)

    def emit(self, record: logging.LogRecord) -> None:
        fields: dict[str, Any] = getattr(record, "fields", {})
        utc = datetime.fromtimestamp(record.created, timezone.utc)
        dive_s = self._dive_s()
        entry = {
            "t_s": None if dive_s is None else round(dive_s, 3),
            "utc": utc.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **fields,
        }
        if record.exc_info and record.exc_info[0] is not None:
            entry["exception"] = _FORMATTER.formatException(record.exc_info)
        admitted = self._repeats.admit(entry, record.name, record.levelname, entry["message"])
        if admitted is not None:
            self._write(admitted)

    def close(self) -> None:
        for name, level in self._levels_before.items():
            logger = logging.getLogger(name)
            logger.removeHandler(self)
            logger.setLevel(level)
        self.acquire()
        try:
            for entry in self._repeats.held_entries():
                self._write(entry)
            with contextlib.suppress(OSError):
                self._stream.close()
        finally:
            self.release()
        super().close()

    def _write(self, entry: dict[str, Any]) -> None:
        if self._stream.closed:  # another thread was about to log when the dive ended
            return
        with contextlib.suppress(OSError):  # a full disk costs log lines, not the dive
            self._stream.write(json.dumps(entry, default=str) + "\n")
            self._stream.flush()


# --------------------------------------------------------------------------------------------------
# Which entries of a log are written: repeats are counted, so that a fault of hours stays small.

WHOLE = 10
"""Entries of one kind that are all written: the history of a usual dive has no gaps."""
EVERY_S = 60.0
"""Of further ones, one is written so often: a link that comes and goes every second for an hour
takes 140 lines instead of 7200."""
KINDS = 1000
"""Kinds that are remembered; the one that was not met for longest is forgotten first."""
DIGITS = re.compile(r"\d+")
"""Texts that differ in their numbers are of one kind."""

Entry: TypeAlias = dict[str, Any]


@dataclass
class _Met:
    """What is known of one kind."""

    times: int = 0
    written_s: float = 0.0
    held: Entry = field(default_factory=dict)
    """The newest that was not written."""
    left_out: int = 0
    """Since the last that was written."""


class Repeats:
    """Decides for each entry; not thread-safe by itself."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._met: OrderedDict[tuple[str, ...], _Met] = OrderedDict()

    def admit(self, entry: Entry, *words: str) -> Entry | None:
        """The entry if it is to be written, with the count of those like it that were ``left_out``
        before; None if it is counted only. ``words``, such as its text, say what it is like."""
        kind, now_s = tuple(DIGITS.sub("#", word) for word in words), self._now_s()
        met = self._met.setdefault(kind, _Met())
        self._met.move_to_end(kind)
        if len(self._met) > KINDS:
            self._met.popitem(last=False)
        met.times += 1
        if met.times > WHOLE and now_s - met.written_s < EVERY_S:
            met.held, met.left_out = entry, met.left_out + 1
            return None
        left_out, met.written_s, met.left_out = met.left_out, now_s, 0
        return _count(entry, left_out)

    def held_entries(self) -> list[Entry]:
        """The newest of each kind that was not written, for the end of the log."""
        waiting = [met for met in self._met.values() if met.left_out]
        self._met.clear()
        return [_count(met.held, met.left_out - 1) for met in waiting]


def _count(entry: Entry, left_out: int) -> Entry:
    return {**entry, "left_out": left_out} if left_out else entry
