"""Work beside the frames: in step with them in a replay, in threads on a vehicle.

Tracking asks for what no pose waits for (loops, keyframes to return to, frames of the past), and
the keyframe graph starts one long optimisation after the other. Neither knows where the work is
done: results are plain data, taken in the order of asking. How many threads there may be, and how a
signal ends a long run, is said here too.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Event
from typing import Any, TypeVar

from aquaflow.base.clocks.deadline import Deadline
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


LONGEST_REST_S = 5.0
"""Longest rest; a fit of the water works for longer, but is rare."""
LOOK_S = 0.02
"""Between two looks of who rests whether tracking is in time again."""


class Lateness:
    """How late tracking is, and how work beside it gives way to that: with few cores it competes
    with tracking for Python's lock, the memory, and the core itself."""

    def __init__(self, sleep: Callable[[float], object] = time.sleep) -> None:
        self.times = 0.0
        """The newest frame's lag, in multiples of the longest that is in time."""
        self.rests = 0
        """Pieces of work after which there was a rest."""
        self._sleep = sleep

    @property
    def late(self) -> bool:
        """True while work beside tracking has to give way."""
        return self.times > 1.0

    def rest(self, worked_s: float, meanwhile: Callable[[], object] = lambda: None) -> None:
        """After ``worked_s`` of work: rest ``times`` squared as long, if tracking is late, and no
        longer than it is. On two cores at 40 % rests of ``times`` as long left it half a second
        late for good (notes/2026-11-speed.md#small-computer). ``meanwhile`` is called at each look:
        it does what cannot wait."""
        if not self.late:
            return
        self.rests += 1
        until = Deadline(min(worked_s * self.times**2, LONGEST_REST_S))
        while self.late and not until.over:
            meanwhile()
            self._sleep(LOOK_S)


class Worker:
    """Does the work that one thread asks for; that thread takes the results too."""

    def __init__(
        self,
        failures: Failures | None = None,
        threads: bool = False,
        lateness: Lateness | None = None,
    ) -> None:
        """Without ``threads`` a replay repeats bit for bit; with them no frame waits for work.
        What raises is counted in ``failures``; long work gives way to ``lateness``."""
        self._failures = failures or Failures()
        self._lateness = lateness or Lateness()
        self._asking = ThreadPoolExecutor(1, "side work") if threads else None
        self._long = ThreadPoolExecutor(1, "long work")
        self._asked: deque[_Asked] = deque()
        self._began_s = 0.0
        """Of the newest long piece; written and read by its thread."""

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

        def timed() -> T:
            self._began_s = time.monotonic()
            return work()

        started = self._long.submit(timed)
        self._long.submit(lambda: self._lateness.rest(time.monotonic() - self._began_s))
        return started

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
        self._lateness.times = 0.0
        for threads in (self._asking, self._long):
            if threads is not None:
                threads.shutdown(cancel_futures=True)
        self._asked.clear()


# --------------------------------------------------------------------------------------------------
# How many threads may work: one for each core, however many are asked for.
#
# More only wait for each other, and thousands of them stop the machine.

log = logging.getLogger(__name__)


def core_count() -> int:
    """Cores of this machine."""
    return os.cpu_count() or 1


def usable_threads(asked: int | None) -> int:
    """``asked``, or every core if None, and never more than there are; warns where it is less."""
    cores = core_count()
    if asked is None or asked <= cores:
        return asked or cores
    log.warning("note: %d threads were asked for; one for each of %d cores is used", asked, cores)
    return cores


# --------------------------------------------------------------------------------------------------
# Clean end of a long run on SIGINT (Ctrl-C) or SIGTERM (systemd).

ASKED = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_on_signals(*stopping: Event, once: bool = False) -> Iterator[None]:
    """Either signal sets all of ``stopping``; with ``once``, the next one ends the process as it
    stands. The previous handlers are restored at the end."""

    def stop(*_: object) -> None:
        for event in stopping:
            event.set()
        for each in ASKED if once else ():
            signal.signal(each, signal.SIG_DFL)

    before: list[Callable[..., object] | int | None] = []
    with contextlib.suppress(ValueError):  # only the main thread may set handlers
        before = [signal.signal(each, stop) for each in ASKED]
    try:
        yield
    finally:
        for each, handler in zip(ASKED, before, strict=False):
            signal.signal(each, handler)
