"""What goes wrong with links and clocks, on purpose and reproducibly.

Any byte link can be wrapped; a CAN bus is one too.
"""

from __future__ import annotations

import heapq
import itertools
import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from aquaflow.drivers.link import MAX_READ_BYTES, ByteLink, LinkLostError
from aquaflow.drivers.transport import OpenLink

OVERTAKEN_S = 0.05
"""A reordered read comes by so much later; at 50 Hz two others pass it."""


@dataclass(frozen=True)
class Faults:
    """Probabilities are per read that brought bytes."""

    seed: int = 0
    drop: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    """Some of the read's bytes are changed."""
    reorder: float = 0.0
    delay_s: float = 0.0
    """Longest; each read is late by a random part of it."""
    flood: float = 0.0
    """As many random bytes as one read takes come first."""
    disconnect_after: int | None = None
    """Reads until the link is lost, each time it is opened."""


class FaultyLink:
    """A link with faults."""

    def __init__(
        self,
        link: ByteLink,
        faults: Faults,
        rng: random.Random,
        injected: Counter[str],
    ) -> None:
        self.name = link.name
        self._link, self._faults = link, faults
        self._rng = rng
        self.injected = injected
        self._reads = 0
        self._order = itertools.count()
        self._waiting: list[tuple[float, int, bytes]] = []

    def read(self, timeout_s: float) -> bytes:
        if self._waiting:
            timeout_s = min(timeout_s, max(self._waiting[0][0] - time.monotonic(), 0.0))
        data = self._link.read(timeout_s)
        if data:
            self._count_down()
            for chunk in self._disturb(data):
                heapq.heappush(self._waiting, (self._due(), next(self._order), chunk))
        return self._take_arrived()

    def write(self, data: bytes) -> None:
        self._link.write(data)

    def close(self) -> None:
        self._link.close()

    def _count_down(self) -> None:
        self._reads += 1
        if self._faults.disconnect_after and self._reads > self._faults.disconnect_after:
            self.injected["disconnect"] += 1
            self._link.close()
            raise LinkLostError("disconnected by the fault injector")

    def _disturb(self, data: bytes) -> list[bytes]:
        """The bytes of one read after the faults."""
        if self._happens("drop", self._faults.drop):
            return []
        if self._happens("corrupt", self._faults.corrupt):
            data = corrupt(data, self._rng)
        chunks = [data]
        if self._happens("duplicate", self._faults.duplicate):
            chunks.append(data)
        if self._happens("flood", self._faults.flood):
            chunks.insert(0, self._rng.randbytes(MAX_READ_BYTES))
        return chunks

    def _due(self) -> float:
        late_s = self._rng.random() * self._faults.delay_s
        if self._happens("reorder", self._faults.reorder):
            late_s += OVERTAKEN_S
        return time.monotonic() + late_s

    def _take_arrived(self) -> bytes:
        arrived = b""
        while self._waiting and self._waiting[0][0] <= time.monotonic():
            if arrived and len(arrived) + len(self._waiting[0][2]) > MAX_READ_BYTES:
                break
            arrived += heapq.heappop(self._waiting)[2]
        return arrived

    def _happens(self, fault: str, probability: float) -> bool:
        happens = self._rng.random() < probability
        self.injected[fault] += happens
        return happens


def faulty(open_link: OpenLink, faults: Faults) -> tuple[OpenLink, Counter[str]]:
    """``open_link`` with faults, and the count of each fault as it is injected."""
    rng = random.Random(faults.seed)
    injected: Counter[str] = Counter()
    return lambda: FaultyLink(open_link(), faults, rng, injected), injected


def corrupt(data: bytes, rng: random.Random, share: float = 0.01) -> bytes:
    """``data`` with a ``share`` of its bytes, at least one, changed."""
    changed = bytearray(data)
    for _ in range(max(1, round(share * len(data)))):
        changed[rng.randrange(len(data))] ^= rng.randrange(1, 256)
    return bytes(changed)


def jumping_clock(clock: Callable[[int], int], at_ns: int, by_ns: int) -> Callable[[int], int]:
    """``clock`` of a simulated device, set forward or back ``at_ns`` after its start."""
    return lambda elapsed_ns: clock(elapsed_ns) + (by_ns if elapsed_ns >= at_ns else 0)
