"""Who does the jobs: a protocol, and the processes of this machine."""

from __future__ import annotations

import queue
import threading
from typing import Protocol

from aquaflow.lab.batch.job import BatchOutcome, Job
from aquaflow.lab.batch.run_job import RunningProcesses, run_job


class Workers(Protocol):
    """Do jobs, several at once; each by :func:`aquaflow.lab.batch.run_job.run_job`."""

    def takes(self, job: Job) -> bool:
        """True if ``job`` may be started now."""
        ...

    def start(self, job: Job) -> None:
        """Begin ``job``; returns at once.

        Raises:
            InputError: there is no one any more who could do it.
        """
        ...

    def wait(self, timeout_s: float) -> tuple[str, BatchOutcome] | None:
        """Name and outcome of a job that has ended; None if none does in time.

        Raises:
            InputError: there is no one any more who could end one.
        """
        ...

    def close(self) -> None:
        """Stop what still runs, and release everything."""
        ...


class LocalWorkers:
    """A process for each job, as many at once as cores and memory allow."""

    def __init__(self, cores: int, memory_mb: int, most: int | None = None) -> None:
        """Use ``cores`` and ``memory_mb`` (1e6 bytes) for at ``most`` so many jobs at once."""
        self._cores, self._memory_mb, self._most = cores, memory_mb, most
        self._jobs: dict[str, Job] = {}
        self._ended: queue.SimpleQueue[tuple[str, BatchOutcome]] = queue.SimpleQueue()
        self._started = RunningProcesses()
        self._threads: list[threading.Thread] = []

    def takes(self, job: Job) -> bool:
        """True if its cores and memory are free; one alone is always taken."""
        if not self._jobs:
            return True
        if self._most is not None and len(self._jobs) >= self._most:
            return False
        taken = self._jobs.values()
        return (
            sum(each.threads for each in taken) + job.threads <= self._cores
            and sum(each.memory_mb for each in taken) + job.memory_mb <= self._memory_mb
        )

    def start(self, job: Job) -> None:
        """Begin in a thread that waits for the process."""
        self._jobs[job.name] = job
        self._threads = [each for each in self._threads if each.is_alive()]
        thread = threading.Thread(target=self._run, args=(job,), name=job.name)
        self._threads.append(thread)
        thread.start()

    def _run(self, job: Job) -> None:
        self._ended.put((job.name, run_job(job, self._started)))

    def wait(self, timeout_s: float) -> tuple[str, BatchOutcome] | None:
        """The next that ends."""
        try:
            name, outcome = self._ended.get(timeout=timeout_s)
        except queue.Empty:
            return None
        del self._jobs[name]
        return name, outcome

    def close(self) -> None:
        """Kill the processes that still run, and wait until their working folders are gone."""
        self._started.stop()
        for thread in self._threads:
            thread.join()
