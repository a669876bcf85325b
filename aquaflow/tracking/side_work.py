"""Work that no pose waits for: done at once, or in a thread, its results taken between frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from aquaflow.base.errors.failures import Failures

T = TypeVar("T")


@dataclass(frozen=True)
class _Pending:
    """Work in the thread, and what is done with its result."""

    stage: str
    frame: int
    future: Future[Any]
    then: Callable[[Any], None]


class SideWork:
    """Does one piece of work after the other; to be used from one thread."""

    def __init__(self, failures: Failures | None = None, threaded: bool = False) -> None:
        """``threaded``: in a thread, for a live run; else at once, and a replay repeats bit for
        bit. What raises is counted in ``failures``."""
        self._failures = failures or Failures()
        self._executor = ThreadPoolExecutor(1, "side work") if threaded else None
        self._pending: deque[_Pending] = deque()

    def do(self, stage: str, frame: int, work: Callable[[], T], then: Callable[[T], None]) -> None:
        """Call ``work``, and ``then`` with its result: now, or in :meth:`settle`.

        ``work`` of a ``threaded`` one reads nothing that changes meanwhile. What either raises is
        a failure of ``stage`` at ``frame``.
        """
        if self._executor is None:
            with self._failures.contain(stage, frame):
                then(work())
        else:
            future = self._executor.submit(work)
            self._pending.append(_Pending(stage, frame, future, then))

    def settle(self, wait: bool = False) -> None:
        """Take the results of what has ended, in the order of asking; ``wait``: of everything."""
        while self._pending and (wait or self._pending[0].future.done()):
            done = self._pending.popleft()
            with self._failures.contain(done.stage, done.frame):
                done.then(done.future.result())

    def awaits(self, stage: str) -> bool:
        """True if a result of ``stage`` has not been taken yet."""
        return self.waiting(stage) > 0

    def waiting(self, stage: str) -> int:
        """Results of ``stage`` that have not been taken yet."""
        return sum(each.stage == stage for each in self._pending)

    def close(self) -> None:
        """End the thread; what it has not begun is left out, and so are all results."""
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
        self._pending.clear()
