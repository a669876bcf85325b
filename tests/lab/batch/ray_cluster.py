"""A real Ray cluster of two nodes with a core each, started as its manual says, on this machine."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.small_recording import GIVE_UP_S

RAY = str(Path(sys.executable).with_name("ray"))
STORE_BYTES = "80000000"
"""Of Ray's object store, which dives do not use."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def descendants(root: int) -> list[int]:
    """``root`` and every process below it."""
    parents: dict[int, int] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = status.read_text().rpartition(")")[2].split()
            parents[int(status.parent.name)] = int(fields[1])
    found = [root]
    for process in found:
        found += [child for child, parent in parents.items() if parent == process]
    return found


class Node:
    """``ray start --block``: everything of a node is below this process."""

    def __init__(self, environment: dict[str, str], *arguments: str) -> None:
        self._process = subprocess.Popen(
            [RAY, "start", "--block", "--num-cpus", "1", "--disable-usage-stats",
             "--object-store-memory", STORE_BYTES, *arguments],
            env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip

    def kill(self) -> None:
        """As a power cut would."""
        for process in descendants(self._process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        self._process.wait()


class TwoNodes:
    """A head and another node."""

    def __init__(self, environment: dict[str, str], folder: str) -> None:
        port = free_port()
        self.address = f"127.0.0.1:{port}"
        head = ("--head", "--port", str(port), "--include-dashboard=false", "--temp-dir", folder)
        self.head = Node(environment, *head)
        self.other: Node | None = None
        try:
            self._wait(port)
            self.other = Node(environment, "--address", self.address)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End both nodes and nothing else."""
        for node in (self.other, self.head):
            if node is not None:
                node.kill()

    def _wait(self, port: int) -> None:
        give_up_s = time.monotonic() + GIVE_UP_S
        while time.monotonic() < give_up_s:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
                return
            time.sleep(0.2)
        raise AssertionError("Ray's head did not come up")


@contextlib.contextmanager
def two_nodes(environment: dict[str, str]) -> Iterator[TwoNodes]:
    """A cluster whose nodes have this environment; gone after the block."""
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # its sockets' names must be short
    cluster = TwoNodes(environment, folder)
    try:
        yield cluster
    finally:
        cluster.stop()
        shutil.rmtree(folder, ignore_errors=True)
