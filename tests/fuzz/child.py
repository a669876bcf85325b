"""One run of a command in a forked process, with limits, and what became of it.

The parent has torch and the rest imported but has never computed with them, so that a fork is
cheap and starts without threads.
"""

from __future__ import annotations

import atexit
import faulthandler
import gc
import os
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .loopback import only_loopback
from .privileges import become_nobody

MEMORY_BYTES = 6 << 30
FILE_BYTES = 128 << 20
OPEN_FILES = 512
LOOK_S = 0.01

OUT, ERR = ".stdout", ".stderr"


def temporary_of(folder: Path) -> Path:
    """Where a command that runs in ``folder`` puts what is temporary."""
    return folder.with_name(f"{folder.name}.tmp")


def home_of(folder: Path) -> Path:
    """The home of a command that runs in ``folder``: its caches, and what it notes of mistakes."""
    return folder.with_name("home")


@dataclass(frozen=True)
class Limits:
    """How long a run may take."""

    interrupt_s: float | None
    """Then it gets what Ctrl-C sends; None: never."""
    hang_s: float = 60.0
    """From the start, or from the Ctrl-C; then it is killed. On a machine with other work to do,
    as much longer as there are more processes that want to run than cores."""


@dataclass(frozen=True)
class Ended:
    """A run that is over."""

    code: int
    """Exit code; minus the signal's number where one ended it."""
    out: str
    err: str
    wall_s: float
    memory_mb: float
    """Most memory of the process itself."""
    interrupted: bool
    hung: bool
    orphans: bool
    """Processes that it started outlived it."""


def run_forked(main: Callable[[], None], argv: list[str], folder: Path, limits: Limits) -> Ended:
    """Run ``main`` in ``folder`` as a program called with ``argv``."""
    streams = folder.with_name(folder.name + OUT), folder.with_name(folder.name + ERR)
    started = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _become_the_program(main, argv, folder, streams)
    status, usage, interrupted, hung = _waited(pid, limits)
    orphans = _kill_group(pid)
    code = os.waitstatus_to_exitcode(status)
    out, err = (stream.read_text(errors="replace") for stream in streams)
    for stream in streams:
        stream.unlink()
    wall_s = time.monotonic() - started
    return Ended(code, out, err, wall_s, usage.ru_maxrss / 1024, interrupted, hung, orphans)


def _waited(pid: int, limits: Limits) -> tuple[int, resource.struct_rusage, bool, bool]:
    began = time.monotonic()
    interrupted = hung = False
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            return status, usage, interrupted, hung
        waited_s = time.monotonic() - began
        if not interrupted and limits.interrupt_s is not None and waited_s > limits.interrupt_s:
            os.killpg(pid, signal.SIGINT)
            interrupted, began = True, time.monotonic()
        elif waited_s > limits.hang_s * _slowness():
            os.kill(pid, signal.SIGABRT)  # faulthandler writes where every thread is
            time.sleep(1.0)
            os.killpg(pid, signal.SIGKILL)
            hung, began = True, time.monotonic()
        time.sleep(LOOK_S)


def _slowness() -> float:
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def _kill_group(pid: int) -> bool:
    """True if there was anybody left to kill."""
    try:
        os.killpg(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def _become_the_program(
    main: Callable[[], None], argv: list[str], folder: Path, streams: tuple[Path, Path]
) -> None:
    """Never returns."""
    code = 70  # of a fault of the fuzzer itself
    try:
        os.setsid()
        _redirect(streams)
        _limit()
        os.chdir(folder)
        os.environ["TMPDIR"] = tempfile.tempdir = str(temporary_of(folder))
        for variable in ("HOME", "XDG_STATE_HOME", "TORCHINDUCTOR_CACHE_DIR"):
            os.environ[variable] = str(home_of(folder))
        become_nobody()
        only_loopback()
        gc.callbacks.clear()  # Hypothesis's
        sys.argv = argv
        code = _exit_code_of(main)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _redirect(streams: tuple[Path, Path]) -> None:
    """Standard output and error as a shell would: to files, in UTF-8."""
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    for number, path in zip((1, 2), streams, strict=True):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.stdin = os.fdopen(0, closefd=False)
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)
    faulthandler.enable(sys.stderr, all_threads=True)
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_NOFILE, (OPEN_FILES, OPEN_FILES))
    os.nice(5)


def _exit_code_of(main: Callable[[], None]) -> int:
    """As the interpreter ends: a message or a traceback, other threads awaited, then flushed."""
    code = 0
    try:
        main()
    except SystemExit as end:
        code = _code_of(end)
    except BaseException:
        traceback.print_exc()
        code = 1
    atexit._clear()  # the parent's own
    threading._shutdown()  # type: ignore[attr-defined]
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        traceback.print_exc()
        code = 120
    sys.stderr.flush()
    return code


def _code_of(end: SystemExit) -> int:
    if end.code is None or isinstance(end.code, int):
        return end.code or 0
    print(end.code, file=sys.stderr)
    return 1
