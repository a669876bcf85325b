"""How the data of one device flow: how many a second, how old the newest is, how late it came."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

WINDOW_S = 10
"""Seconds over which rate and lag are taken: a fix each 5 s still has a rate."""
SECOND_NS = 1_000_000_000


class _Second:
    """What came within one second."""

    __slots__ = ("count", "lag_ns", "number")

    def __init__(self, number: int) -> None:
        self.number, self.count, self.lag_ns = number, 0, 0


class DeviceState:
    """Written by the device's thread, read by anyone."""

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._now_ns = now_ns
        self._newest_ns: int | None = None
        self._first = 0
        """The second in which the first one came."""
        self._seconds: deque[_Second] = deque(maxlen=WINDOW_S + 1)

    def record(self, measured_ns: int, arrival_ns: int) -> None:
        """A picture or a sample; both moments are CLOCK_MONOTONIC."""
        number = arrival_ns // SECOND_NS
        if self._newest_ns is None:
            self._first = number
        self._newest_ns = arrival_ns
        if not self._seconds or self._seconds[-1].number != number:
            self._seconds.append(_Second(number))
        second = self._seconds[-1]
        second.count += 1
        second.lag_ns += arrival_ns - measured_ns

    def to_json(self) -> dict[str, float | None]:
        """``rate_hz`` over the last whole seconds, ``age_s`` of the newest, and ``lag_ms``, the
        mean time from measurement to arrival; None where nothing came."""
        now_ns, newest_ns = self._now_ns(), self._newest_ns
        if newest_ns is None:
            return {"rate_hz": None, "age_s": None, "lag_ms": None}
        number = now_ns // SECOND_NS
        recent = [each for each in list(self._seconds) if number - each.number <= WINDOW_S]
        whole = sum(each.count for each in recent if each.number < number)
        count, lag_ns = sum(each.count for each in recent), sum(each.lag_ns for each in recent)
        return {
            "rate_hz": round(whole / min(WINDOW_S, max(1, number - self._first)), 2),
            "age_s": round((now_ns - newest_ns) * 1e-9, 3),
            "lag_ms": round(lag_ns * 1e-6 / count, 3) if count else None,
        }
