"""Where the time goes: named stages, measured with a monotonic clock."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypedDict

import numpy as np


class StageTime(TypedDict):
    """Milliseconds that one stage took."""

    count: int
    total: float
    p50: float
    p95: float


class Profiler:
    """Collects durations per stage; stages may nest, each counts its own wall time."""

    def __init__(self) -> None:
        self._durations: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the block as one run of ``name``."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self._durations[name].append((time.perf_counter() - started) * 1e3)

    def summary(self) -> dict[str, StageTime]:
        """Per stage: how often, total, median and 95th percentile in milliseconds."""
        return {
            name: StageTime(
                count=len(values),
                total=round(float(np.sum(values)), 3),
                p50=round(float(np.percentile(values, 50)), 3),
                p95=round(float(np.percentile(values, 95)), 3),
            )
            for name, values in self._durations.items()
        }
