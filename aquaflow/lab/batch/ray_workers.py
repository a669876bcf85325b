"""The nodes of a Ray cluster as workers, by a process that talks to it (ray_driver.py)."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from typing import Any

from aquaflow.base.errors import InputError
from aquaflow.lab.batch.job import BatchOutcome, Job

PROGRAM = "aquaflow.lab.batch.ray_driver"
JOIN_S = 90.0
"""To reach a cluster; Ray tries for half a minute by itself."""
SILENT_S = 45.0
"""Without a word of the cluster before it counts as gone. Ray's own nodes give a head that is
restarted 60 s; a head that only is busy answers within seconds."""
QUEUED_PER_CORE = 2
"""Jobs that the cluster is given beyond those it works on: enough that no core waits for us."""


class RayWorkers:
    """Nodes of a cluster; Ray packs jobs on them by the cores and memory that they ask for."""

    def __init__(self, address: str, most: int | None = None) -> None:
        """Join the cluster at ``address`` ("auto", "host:6379" or "ray://host:10001"); at ``most``
        so many dives at once.

        Raises:
            InputError: Ray is not installed, or there is no cluster.
        """
        if find_spec("ray") is None:
            raise InputError("a cluster needs Ray; run `pip install 'aquaflow[cluster]'`")
        self._address, self._most = address, most
        self._running: set[str] = set()
        self._cores = 0.0
        self._messages: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-m", PROGRAM, address, str(os.getpid())], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
            env=dict(os.environ) | {"RAY_USAGE_STATS_ENABLED": "0"},
        )  # fmt: skip
        threading.Thread(target=self._listen, daemon=True).start()
        self._heard_s = time.monotonic() + JOIN_S - SILENT_S
        try:
            while not self._cores:
                self.wait(1.0)
        except BaseException:
            self.close()
            raise

    def takes(self, job: Job) -> bool:
        """True until the cluster has some more than it can work on: it packs them itself."""
        most = max(1, int(self._cores)) * (1 + QUEUED_PER_CORE)
        return len(self._running) < (most if self._most is None else min(most, self._most))

    def start(self, job: Job) -> None:
        """Hand the job to the cluster."""
        assert self._process.stdin is not None
        self._running.add(job.name)
        try:
            self._process.stdin.write(json.dumps(job.to_json()).encode() + b"\n")
            self._process.stdin.flush()
        except OSError as error:
            raise self._lost_workers_error("its driver ended") from error

    def wait(self, timeout_s: float) -> tuple[str, BatchOutcome] | None:
        """The next job that ends."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                left_s = max(0.0, deadline_s - time.monotonic())
                message = self._messages.get(timeout=left_s)
            except queue.Empty:
                if time.monotonic() - self._heard_s > SILENT_S:
                    raise self._lost_workers_error("it is silent") from None
                return None
            self._heard_s = time.monotonic()
            if message is None:
                raise self._lost_workers_error("it ended")
            if "failed" in message:
                raise self._lost_workers_error(str(message["failed"]))
            self._cores = message.get("cores", self._cores)
            if "done" in message:
                self._running.discard(message["done"])
                return message["done"], BatchOutcome.of_json(message["outcome"])

    def close(self) -> None:
        """Leave the cluster, which then stops what it works on for us."""
        self._process.kill()
        self._process.wait()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._messages.put(json.loads(line))
        self._messages.put(None)

    def _lost_workers_error(self, why: str) -> InputError:
        begun = "; give the same command again to go on" if self._cores else ""
        return InputError(f"the Ray cluster at {self._address} cannot be used ({why}){begun}")
