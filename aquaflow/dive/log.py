"""log.jsonl: what happened in a dive, for programs to read."""

from __future__ import annotations

import contextlib
import io
import json
import logging
from collections import deque
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, TextIO

from aquaflow.base.storage.atomic import open_to_append
from aquaflow.base.storage.lines import is_cut_short
from aquaflow.dive.log_repeats import Repeats

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

    def taken(self) -> list[logging.LogRecord]:
        """End, and the records."""
        self._logger.removeHandler(self)
        self._logger.setLevel(self._level_before)
        return list(self._records)


def _early() -> list[EarlyRecords]:
    handlers = logging.getLogger(LOGGERS[0]).handlers
    return [handler for handler in handlers if isinstance(handler, EarlyRecords)]


def _opened(path: Path, append: bool) -> TextIO:
    if not append:
        path.unlink(missing_ok=True)
    return io.TextIOWrapper(open_to_append(path), encoding="utf-8")


class JsonLog(logging.Handler):
    """One JSON object a line, flushed at once; a record's ``fields`` become keys of their own.

    What repeats is counted: see :mod:`aquaflow.dive.log_repeats`.
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
        self._stream = _opened(path, append)
        if cut_short:  # what follows begins a line of its own
            self._stream.write("\n")
        self._levels_before: dict[str, int] = {}
        self._dive_s, self._repeats = dive_s, Repeats()

    def attach(self) -> None:
        """Receive what AquaFlow logs from here on, until closed, and what was kept for it."""
        early = [record for each in _early() for record in each.taken()]
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
            for entry in self._repeats.held():
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
