"""How many tensors crossed between the host and the map's device, by the name of the crossing."""

from __future__ import annotations

import threading
from collections import Counter


class TransferCounts:
    """Counters that several threads may use."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, name: str, tensors: int = 1) -> None:
        """``tensors`` were moved by the function ``name``."""
        with self._lock:
            self._counts[name] += tensors

    def take(self) -> dict[str, int]:
        """The counts so far, by name."""
        with self._lock:
            return dict(self._counts)


COUNTS = TransferCounts()
"""Of this process."""


def transfers() -> dict[str, int]:
    """Tensors moved so far in this process, by the name of the function that moved them."""
    return COUNTS.take()
