"""The memory of this program, as the kernel counts it."""

from __future__ import annotations

from pathlib import Path


def resident_mb() -> float | None:
    """MB in memory now; None where the system does not report it."""
    return _status_mb("VmRSS:")


def peak_memory_mb() -> float | None:
    """The most MB that were in memory, of this program alone; None where the system does not
    report it.

    getrusage's maximum is inherited: it holds the memory of the process that started this one.
    """
    return _status_mb("VmHWM:")


def _status_mb(name: str) -> float | None:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith(name)]
    return round(int(found[0]) / 1024.0, 1) if found else None
