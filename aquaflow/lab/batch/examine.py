"""A look at every recording before the first is mapped, in a process that one of them may crash."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from types import TracebackType

from aquaflow.lab.batch.estimate import Examined
from aquaflow.lab.batch.object_store import is_url

PROGRAM = "aquaflow.lab.batch.examining_process"
PATIENCE_S = 120.0
"""For one recording; a video's index takes well under a second, a long bag's several."""


class Examiner:
    """Looks at one recording after the other."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Examiner:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end()

    def look(self, source: str) -> Examined:
        """What can be known of the recording at ``source``; nothing of one in an object store,
        or one that crashes who looks at it."""
        if is_url(source):
            return Examined()
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        alarm = threading.Timer(PATIENCE_S, process.kill)
        alarm.start()
        try:
            process.stdin.write(json.dumps(source).encode() + b"\n")
            process.stdin.flush()
            return Examined(**json.loads(process.stdout.readline()))
        except (OSError, ValueError, TypeError):
            self._end()
            return Examined()
        finally:
            alarm.cancel()

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None
