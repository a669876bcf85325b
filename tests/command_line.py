"""``aquaflow`` as a user runs it: a process for each command, its output and its exit status.

The processes are forks of one that has imported torch already (``command_server.py``), because
importing it costs more than most commands. What is about the start of the interpreter
(``test_start_up.py``) or about signals starts the installed script instead.
"""

from __future__ import annotations

import atexit
import functools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.errors.crash_report import FAILED

TIMEOUT_S = 900.0
"""A command that hangs fails its test; the slowest here takes 20 s of CPU on an idle machine."""


@dataclass(frozen=True)
class Ran:
    """A finished command."""

    code: int
    out: str
    err: str


Cli = Callable[..., Ran]


def run_aquaflow(
    *arguments: object,
    timeout_s: float = TIMEOUT_S,
    meanwhile: Callable[[int], None] = lambda _: None,
) -> Ran:
    """Run ``aquaflow`` with ``arguments``; one that runs longer than ``timeout_s`` is killed.
    ``meanwhile`` is called with its process id, and may kill it."""
    with tempfile.TemporaryDirectory(prefix="aquaflow-command-") as folder:
        out, err = Path(folder) / "out", Path(folder) / "err"
        command = {
            "words": ["aquaflow", *map(str, arguments)],
            "environment": dict(os.environ),
            "folder": str(Path.cwd()),
            "out": str(out),
            "err": str(err),
        }
        code = _answer(json.dumps(command), timeout_s, meanwhile)
        return Ran(code, _text(out), _text(err))


def refused(ran: Ran, *named: object, code: int = FAILED) -> None:
    """The command failed with one sentence that names the input."""
    assert ran.code == code
    assert ran.out == ""
    assert "Traceback" not in ran.err
    (line,) = ran.err.splitlines()
    assert line.startswith("aquaflow: ")
    for name in named:
        assert str(name) in line


def _answer(line: str, timeout_s: float, meanwhile: Callable[[int], None]) -> int:
    """The exit status of one command; as with subprocess, minus the signal that ended it."""
    server = _server()
    assert server.stdin is not None
    assert server.stdout is not None
    server.stdin.write(line + "\n")
    server.stdin.flush()
    process_id = int(server.stdout.readline())
    alarm = threading.Timer(timeout_s, os.kill, (process_id, signal.SIGKILL))
    alarm.start()
    try:
        meanwhile(process_id)
        return int(server.stdout.readline())
    finally:
        alarm.cancel()


@functools.cache
def _server() -> subprocess.Popen[str]:
    program = Path(__file__).with_name("command_server.py")
    server = subprocess.Popen(
        [sys.executable, str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    atexit.register(server.communicate)  # ends its input, then waits
    return server


def _text(file: Path) -> str:
    return file.read_text() if file.exists() else ""
