"""A group of processes to which the kernel gives no more than a small computer has.

Control groups of version 1, which only root may make: the folders of /sys/fs/cgroup.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
PERIOD_US = 100_000
"""In which the kernel hands out CPU time: its default."""
SHARES = 262_144
"""The most there is: beside other programs the quota is the limit, not they."""
LEAVING_S = 10.0
"""Longest wait until the last process has left a group that is removed."""


class ControlGroup:
    """Removed at the end, when its processes have ended."""

    def __init__(self, name: str, cores: int, share: float, memory_mb: int) -> None:
        """``share`` of each of the first ``cores``.

        Raises:
            OSError: there are no such groups here, or this user may not make them.
        """
        self._folders = {kind: ROOT / kind / name for kind in ("cpu", "cpuset", "memory")}
        for folder in self._folders.values():
            folder.mkdir()
        self._write("cpu", "cpu.cfs_period_us", PERIOD_US)
        self._write("cpu", "cpu.cfs_quota_us", round(PERIOD_US * cores * share))
        self._write("cpu", "cpu.shares", SHARES)
        self._write("cpuset", "cpuset.cpus", f"0-{cores - 1}")
        self._write("cpuset", "cpuset.mems", 0)
        self._write("memory", "memory.limit_in_bytes", memory_mb * 1_000_000)

    def enter(self) -> None:
        """Put the calling process in."""
        for folder in self._folders.values():
            (folder / "cgroup.procs").write_text(str(os.getpid()))

    def read(self) -> dict[str, float]:
        """MB of memory with the page cache and the most so far, s throttled, kills for memory."""
        memory = self._folders["memory"]
        cpu = _read_table(self._folders["cpu"] / "cpu.stat")
        kills = _read_table(memory / "memory.oom_control")
        stat = _read_table(memory / "memory.stat")
        return {
            "memory_mb": int((memory / "memory.usage_in_bytes").read_text()) / 1e6,
            "memory_peak_mb": int((memory / "memory.max_usage_in_bytes").read_text()) / 1e6,
            "cache_mb": stat["total_cache"] / 1e6,
            "anonymous_mb": stat["total_rss"] / 1e6,
            "throttled_s": cpu["throttled_time"] / 1e9,
            "periods": cpu["nr_periods"],
            "throttled_periods": cpu["nr_throttled"],
            "oom_kills": kills["oom_kill"],
        }

    def __enter__(self) -> ControlGroup:
        return self

    def __exit__(self, *_: object) -> None:
        until = time.monotonic() + LEAVING_S
        for folder in self._folders.values():
            while (folder / "cgroup.procs").read_text() and time.monotonic() < until:
                time.sleep(0.1)
            with contextlib.suppress(OSError):
                folder.rmdir()

    def _write(self, kind: str, file: str, value: object) -> None:
        (self._folders[kind] / file).write_text(str(value))


def _read_table(path: Path) -> dict[str, int]:
    lines = path.read_text().splitlines()
    return {name: int(value) for name, value in (line.split() for line in lines)}
