"""``python -m aquaflow.lab.batch.ray_driver ADDRESS``: the process that talks to a Ray cluster.

Ray ends a process whose cluster is gone; this one may end, the batch says a sentence. Reads a job
as JSON from each line of stdin, and writes lines: ``{"cores": ..., "nodes": ...}`` while the
cluster answers, ``{"done": name, "outcome": ...}``, ``{"failed": sentence}``. It ends with its
stdin.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import sys
import threading
from typing import IO, Any

from aquaflow.base.errors import first_line
from aquaflow.lab.batch.job import BatchOutcome, Job, job_of_json
from aquaflow.lab.batch.job_process import end_with
from aquaflow.lab.batch.run_job import MEGABYTE, run_job

LOOK_S = 0.5
"""s between looks at what has ended and what is to be begun."""


def attempt(content: dict[str, Any]) -> dict[str, Any]:
    """One attempt at the job that ``content`` describes, on a node."""
    return run_job(job_of_json(content)).to_json()


class Cluster:
    """Jobs on a Ray cluster, and what it has for them."""

    def __init__(self, address: str) -> None:
        """Join the cluster at ``address``.

        Raises:
            Exception: Ray's own, where there is none.
        """
        import ray

        self._ray: Any = ray
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        # Retries are the batch's, which counts them; a worker may be used again, because each dive
        # gets a process of its own.
        self._attempt: Any = ray.remote(max_retries=0)(attempt)
        self._running: dict[Any, str] = {}

    def nodes(self) -> list[dict[str, float]]:
        """What each node that is alive has in all, by Ray's names."""
        return [dict(node["Resources"]) for node in self._ray.nodes() if node["Alive"]]

    def start(self, job: Job) -> None:
        """Queue ``job``, where its cores and memory will be free; one that is too large for every
        node gets a whole one."""
        nodes = self.nodes()
        cores = min(job.threads, max((n.get("CPU", 0.0) for n in nodes), default=0.0) or 1.0)
        largest = max((n.get("memory", 0.0) for n in nodes), default=0.0)
        memory = min(job.memory_mb * MEGABYTE, largest)
        task = self._attempt.options(num_cpus=cores, memory=int(memory), name=job.name)
        self._running[task.remote(job.to_json())] = job.name

    def take_ended(self) -> list[tuple[str, dict[str, Any]]]:
        """Names and outcomes of the jobs that ended since; waits a little."""
        if not self._running:
            return []
        ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=LOOK_S)
        return [(self._running.pop(each), self._outcome(each)) for each in ready]

    def _outcome(self, task: Any) -> dict[str, Any]:
        try:
            found: dict[str, Any] = self._ray.get(task)
        except self._ray.exceptions.RayError as error:
            kind = type(error).__name__
            return BatchOutcome("lost", f"its node or worker was lost ({kind})").to_json()
        return found


def main() -> None:
    """Entry point of the process."""
    end_with(int(sys.argv[2]))
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    asked: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(asked,), daemon=True).start()
    try:
        _serve(Cluster(sys.argv[1]), asked, answers)
    except Exception as error:
        _say(answers, failed=first_line(error))
    os._exit(0)  # Ray's own end waits for a cluster that may be gone


def _read(asked: queue.SimpleQueue[str | None]) -> None:
    for line in sys.stdin:
        asked.put(line)
    asked.put(None)


def _serve(cluster: Cluster, asked: queue.SimpleQueue[str | None], answers: IO[str]) -> None:
    while True:
        nodes = cluster.nodes()
        _say(answers, cores=sum(node.get("CPU", 0.0) for node in nodes), nodes=len(nodes))
        for name, outcome in cluster.take_ended():
            _say(answers, done=name, outcome=outcome)
        try:
            line = asked.get(timeout=LOOK_S)
        except queue.Empty:
            continue
        if line is None:
            return
        cluster.start(job_of_json(json.loads(line)))


def _say(answers: IO[str], **what: Any) -> None:
    print(json.dumps(what), file=answers, flush=True)


if __name__ == "__main__":
    main()
