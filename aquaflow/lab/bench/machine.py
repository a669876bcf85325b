"""What a benchmark ran on: without it, no number of it means anything."""

from __future__ import annotations

import os
import platform
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from aquaflow import __version__

PACKAGES = ("torch", "numpy", "opencv-contrib-python-headless", "pycolmap")
ON_GPU = ("gsplat", "onnxruntime-gpu")
"""Those whose version changes a benchmark's numbers, and on a GPU also these."""


def describe(device: str | None = None) -> dict[str, Any]:
    """Processor, cores, memory, versions and the date (UTC); the GPU if ``device`` is cuda."""
    packages = (*PACKAGES, *ON_GPU) if device == "cuda" else PACKAGES
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "gpu": _gpu() if device == "cuda" else None,
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "aquaflow": __version__,
        "packages": {name: _version(name) for name in packages},
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "load": load(),
    }


def in_words(described: dict[str, Any]) -> str:
    """Processor and cores, and the GPU if the benchmark ran on one."""
    processor = f"{described['processor']}, {described['cores']} cores"
    return f"{processor}, and {described['gpu']}" if described["gpu"] else processor


def load() -> float | None:
    """Mean number of processes that wanted a core in the last minute; None where unknown."""
    try:
        return float(Path("/proc/loadavg").read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _gpu() -> str:
    from aquaflow.render.gsplat import gpu_here

    return str(gpu_here())


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
