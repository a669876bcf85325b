"""log.jsonl: what happened in a dive, for programs to read."""

from __future__ import annotations

import contextlib
import json
import logging
from pathlib import Path

from aquaflow.storage.lines import is_cut_short

LOGGERS = ("aquaflow", "py.warnings")
"""Loggers whose records go to log.jsonl."""


_FORMATTER = logging.Formatter()
"""Writes tracebacks, and nothing else."""


class JsonLog(logging.Handler):
    """One JSON object a line, flushed at once; a record's ``fields`` become keys of their own."""

    def __init__(self, path: Path, append: bool = False) -> None:
        super().__init__(logging.INFO)
        cut_short = append and is_cut_short(path)
        self._stream = path.open("a" if append else "w", encoding="utf-8")
        if cut_short:  # what follows begins a line of its own
            self._stream.write("\n")
        self._levels_before: dict[str, int] = {}

    def attach(self) -> None:
        """Receive what AquaFlow logs from here on, until closed."""
        for name in LOGGERS:
            logger = logging.getLogger(name)
            self._levels_before[name] = logger.level
            logger.setLevel(logging.INFO)
            logger.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        entry = {
            "t": round(record.created, 3),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info and record.exc_info[0] is not None:
            entry["exception"] = _FORMATTER.formatException(record.exc_info)
        with contextlib.suppress(OSError):  # a full disk costs log lines, not the dive
            self._stream.write(json.dumps(entry, default=str) + "\n")
            self._stream.flush()

    def close(self) -> None:
        for name, level in self._levels_before.items():
            logger = logging.getLogger(name)
            logger.removeHandler(self)
            logger.setLevel(level)
        with contextlib.suppress(OSError):
            self._stream.close()
        super().close()
