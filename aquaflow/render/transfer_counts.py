"""How many tensors crossed between the host and the map's device, by the name of the crossing; of
wgpu, which moves buffers, how many bytes."""

from __future__ import annotations

import threading
from collections import Counter


class TransferCounts:
    """Counters that several threads may use."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, name: str, moved: int = 1) -> None:
        """Tensors were ``moved`` by the function ``name``, or bytes by wgpu."""
        with self._lock:
            self._counts[name] += moved

    def take(self) -> dict[str, int]:
        """The counts so far, by name."""
        with self._lock:
            return dict(self._counts)


COUNTS = TransferCounts()
"""Of this process."""


def transfers() -> dict[str, int]:
    """Tensors moved so far in this process, by the name of what moved them; of wgpu, bytes."""
    return COUNTS.take()
