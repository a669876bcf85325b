"""What this machine can lend to a batch: cores, and memory that is free."""

from __future__ import annotations

import os
from pathlib import Path

from aquaflow.lab.batch.run_job import KILOBYTE, MEGABYTE

SHARE_OF_FREE = 0.8
"""Of the free memory that a batch takes by itself: the rest is for files and for what others do."""
LEAST_MB = 512
"""Where the free memory cannot be found out."""


def core_count() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def memory_for_dives_mb(root: Path = Path("/")) -> int:
    """Memory that dives may take together, 1e6 bytes: a share of what is free now."""
    free = [each for each in (_of_machine(root), _of_control_group(root)) if each is not None]
    return round(SHARE_OF_FREE * min(free)) if free else LEAST_MB


def _of_machine(root: Path) -> float | None:
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
        fields = (line.split() for line in lines if line.startswith("MemAvailable:"))
        return int(next(fields)[1]) * KILOBYTE / MEGABYTE
    except (OSError, ValueError, StopIteration):
        return None


def _of_control_group(root: Path) -> float | None:
    """Of a container, or of a unit with MemoryMax."""
    try:
        group = (root / "proc/self/cgroup").read_text().rpartition("::")[2].strip()
        folder = root / "sys/fs/cgroup" / group.lstrip("/")
        limit = int((folder / "memory.max").read_text())
        used = int((folder / "memory.current").read_text())
    except (OSError, ValueError):
        return None  # no limit ("max"), or no control groups of version 2
    return max(limit - used, 0) / MEGABYTE
