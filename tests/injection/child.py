"""One dive in a forked process: its exit code, what it said, and where the fault met it."""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LIMIT_S = 240.0
"""Longest that a dive may take on a busy machine; then it hangs."""
HUNG = -1


@dataclass(frozen=True)
class Ended:
    """A dive that has ended."""

    code: int
    """Exit code; HUNG if it had to be killed."""
    err: str
    cpu_s: float
    told: dict[str, Any]
    """What ``work`` in the child returned or noted."""


def forked(work: Callable[[dict[str, Any], Callable[[], None]], None], folder: Path) -> Ended:
    """Run ``work`` in a copy of this process; it may note facts and save them at any time."""
    err, notes = folder / "stderr", folder / "notes.json"
    pid = os.fork()
    if pid == 0:
        _child(work, folder / "stdout", err, notes)
    code, cpu_s = _waited(pid)
    said = err.read_text(errors="replace") if err.exists() else ""
    return Ended(code, said, cpu_s, json.loads(notes.read_text()) if notes.exists() else {})


def _child(
    work: Callable[[dict[str, Any], Callable[[], None]], None], out: Path, err: Path, notes: Path
) -> None:
    code = 1
    try:
        for path, descriptor in ((out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND), descriptor)
        told: dict[str, Any] = {}

        def save() -> None:
            notes.write_text(json.dumps(told))

        try:
            work(told, save)
            code = 0
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        except BaseException:
            traceback.print_exc()
        save()
        sys.stdout.flush()
        sys.stderr.flush()
        logging.shutdown()
    finally:
        os._exit(code)


def _waited(pid: int) -> tuple[int, float]:
    began = time.monotonic()
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            break
        if time.monotonic() - began > LIMIT_S:
            os.kill(pid, signal.SIGKILL)
            _, _, usage = os.wait4(pid, 0)
            return HUNG, usage.ru_utime + usage.ru_stime
        time.sleep(0.01)
    return os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
