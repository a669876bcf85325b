"""One attempt at one job, wherever it is done: the same function on this machine and on a node."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from signal import Signals
from typing import IO, Any

from aquaflow import __version__
from aquaflow.base.errors import InputError
from aquaflow.base.storage.whole_folder import working_folder
from aquaflow.lab.batch.job import WRITTEN, BatchJob, BatchOutcome, CallJob, Job
from aquaflow.lab.batch.job_process import outcome_of_failure
from aquaflow.lab.batch.manifest import write_manifest
from aquaflow.lab.batch.object_store import ObjectStore, StoreError, is_url
from aquaflow.lab.batch.site import DiveStore, open_site

PROGRAM = "aquaflow.lab.batch.job_process"
KILOBYTE = 1024
"""Bytes; what Linux counts resident sets in."""
MEGABYTE = 1e6
"""Bytes."""


def run_job(job: Job, started: RunningProcesses | None = None) -> BatchOutcome:
    """Make the dive of ``job`` if it is not there yet, or call its function; raises nothing.

    ``started`` is told of the process, so that it can be stopped.
    """
    begin_s = time.monotonic()
    try:
        outcome = _attempt(job, started or RunningProcesses())
    except StoreError as error:
        outcome = BatchOutcome("lost", str(error))
    except Exception as error:
        outcome = BatchOutcome(**outcome_of_failure(error))
    if outcome.earlier:
        return outcome
    return replace(outcome, node=socket.gethostname(), wall_s=round(time.monotonic() - begin_s, 3))


def _attempt(job: Job, started: RunningProcesses) -> BatchOutcome:
    if job.version != __version__:
        raise InputError(
            f"{socket.gethostname()} has AquaFlow {__version__}, the batch is of {job.version}; "
            "install the same on every machine"
        )
    if isinstance(job, CallJob):
        return _call(job, started)
    site = open_site(job.site)
    found = site.finished_outcome(job)
    if found is not None:
        return found
    with working_folder(site.work_parent(job), job.name) as work:
        return _make(job, site, work, started)


def _make(job: BatchJob, site: DiveStore, work: Path, started: RunningProcesses) -> BatchOutcome:
    source = job.source
    if is_url(source):
        source = str(ObjectStore(source).fetch(work / "recording"))
    dive = work / "dive"
    outcome = _map(job, source, work, dive, started)
    if outcome.state in WRITTEN:
        write_manifest(dive, job, outcome)
        site.publish(dive, job)
    return outcome


def _call(job: CallJob, started: RunningProcesses) -> BatchOutcome:
    asked = {"function": job.function, "arguments": job.arguments, "parent": os.getpid()}
    with tempfile.TemporaryFile() as said:
        return _ask(job, asked, said, started)


def _map(
    job: BatchJob, source: str, work: Path, dive: Path, started: RunningProcesses
) -> BatchOutcome:
    calibration = None
    if job.calibration is not None:
        calibration = work / "camera.yaml"
        calibration.write_text(job.calibration, encoding="utf-8")
    asked = {
        "source": source, "out": str(dive), "settings": job.settings, "parent": os.getpid(),
        "calibration": None if calibration is None else str(calibration),
    }  # fmt: skip
    with (work / "said").open("w+b") as said:
        return _ask(job, asked, said, started)


def _ask(
    job: Job, asked: dict[str, Any], said: IO[bytes], started: RunningProcesses
) -> BatchOutcome:
    """Start a process for the job, and wait for it."""
    process = subprocess.Popen(
        [sys.executable, "-m", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=said, env=_environment(job.threads), start_new_session=True,
    )  # fmt: skip
    with started.running(process):
        return _answer(process, json.dumps(asked).encode(), job.memory_mb)


def _environment(threads: int) -> dict[str, str]:
    """This process's variables, with the number of threads of the job whoever runs it: Ray sets
    its own."""
    fixed = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return dict(os.environ) | dict.fromkeys(fixed, str(threads))


def _answer(process: subprocess.Popen[bytes], asked: bytes, memory_mb: int) -> BatchOutcome:
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(asked)
        process.stdin.close()
    except BrokenPipeError:
        pass  # it died at once; how is seen below
    text = process.stdout.read()
    process.stdout.close()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    measured: dict[str, Any] = {
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 3),
        "peak_mb": round(usage.ru_maxrss * KILOBYTE / MEGABYTE, 1),
    }
    try:
        return BatchOutcome(**json.loads(text), **measured)
    except (ValueError, TypeError):
        return BatchOutcome("lost", _death_message(process.returncode, memory_mb), **measured)


def _death_message(code: int, memory_mb: int) -> str:
    if code == -Signals.SIGKILL:
        return (
            f"its process was killed; if that was for want of memory ({memory_mb} MB were expected)"
            ", give fewer --jobs"
        )
    if code < 0:
        return f"its process crashed ({Signals(-code).name}); the recording may be damaged"
    return f"its process ended with status {code} and said nothing"


# --------------------------------------------------------------------------------------------------
# The processes that a batch has started on this machine, to stop them when it ends early.


class RunningProcesses:
    """Processes that run now. Of any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._processes: set[subprocess.Popen[bytes]] = set()
        self._stopped = False

    @contextlib.contextmanager
    def running(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        """``process`` may be stopped while the block runs."""
        with self._lock:
            self._processes.add(process)
            if self._stopped:
                _kill(process)
        try:
            yield
        finally:
            with self._lock:
                self._processes.discard(process)

    def stop(self) -> None:
        """Kill every process, and what is started from now on."""
        with self._lock:
            self._stopped = True
            for process in self._processes:
                _kill(process)


def _kill(process: subprocess.Popen[bytes]) -> None:
    # Not Popen.kill: that may take the status from the thread that waits for it.
    with contextlib.suppress(ProcessLookupError):
        os.kill(process.pid, signal.SIGKILL)
