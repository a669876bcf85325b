"""Work beside the frames: in step with them in a replay, in threads on a vehicle.

Tracking asks for what no pose waits for (loops, keyframes to return to, frames of the past), and
the keyframe graph starts one long optimisation after the other. Neither knows where the work is
done: results are plain data, taken in the order of asking.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from aquaflow.base.errors.failures import Failures

T = TypeVar("T")


@dataclass(frozen=True)
class WorkResult:
    """What one piece of work found."""

    stage: str
    frame: int
    found: Any
    """What the work returned."""


@dataclass(frozen=True)
class _Asked:
    stage: str
    frame: int
    future: Future[Any]


class Worker:
    """Does the work that one thread asks for; that thread takes the results too."""

    def __init__(self, failures: Failures | None = None, threads: bool = False) -> None:
        """Without ``threads`` a replay repeats bit for bit; with them no frame waits for work.
        What raises is counted in ``failures``."""
        self._failures = failures or Failures()
        self._asking = ThreadPoolExecutor(1, "side work") if threads else None
        self._long = ThreadPoolExecutor(1, "long work")
        self._asked: deque[_Asked] = deque()

    @property
    def in_step(self) -> bool:
        """True if what is asked for is done at once, and what is started is waited for at a moment
        that no clock decides; False if results are taken whenever they are there."""
        return self._asking is None

    def ask(self, stage: str, frame: int, work: Callable[[], T]) -> list[T]:
        """Have a short piece of work done: what it returned, where that is known at once;
        otherwise nothing, and :meth:`finished` has it later.

        In a thread, ``work`` must read nothing that changes meanwhile. What it raises is a failure
        of ``stage`` at ``frame``, and costs its result.
        """
        if self._asking is None:
            with self._failures.contain(stage, frame):
                return [work()]
        else:
            self._asked.append(_Asked(stage, frame, self._asking.submit(work)))
        return []

    def start(self, work: Callable[[], T]) -> Future[T]:
        """Do a long piece of work, after the one before it; in a thread in every case, for a replay
        goes on until it needs the result."""
        return self._long.submit(work)

    def take_finished(self, wait: bool = False) -> Iterator[WorkResult]:
        """What has been found of what was asked for, each once; with ``wait`` all of it."""
        while self._asked and (wait or self._asked[0].future.done()):
            asked = self._asked.popleft()
            with self._failures.contain(asked.stage, asked.frame) as run:
                found = asked.future.result()
            if not run.failed:
                yield WorkResult(asked.stage, asked.frame, found)

    def waiting(self, stage: str | None = None) -> int:
        """Pieces of work, of all stages or of one, whose results have not been taken yet."""
        return sum(stage in (None, each.stage) for each in self._asked)

    def drop(self, stage: str) -> None:
        """Wait for what is asked for of ``stage``, and leave its results out."""
        dropped = [each for each in self._asked if each.stage == stage]
        for each in dropped:
            self._asked.remove(each)
            each.future.exception()  # waits

    def close(self) -> None:
        """End the threads; what they have not begun is left out, and so are all results."""
        for threads in (self._asking, self._long):
            if threads is not None:
                threads.shutdown(cancel_futures=True)
        self._asked.clear()
