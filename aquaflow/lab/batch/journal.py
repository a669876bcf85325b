"""``batch.jsonl``: what happened to each dive of a season, one line each, appended to for ever."""

from __future__ import annotations

import contextlib
import json
import os
import time
from pathlib import Path
from typing import Any

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular
from aquaflow.base.storage.atomic import is_cut_short, open_to_append

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
