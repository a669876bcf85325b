"""Work that no frame waits for: in step in a replay, in threads on a vehicle."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Iterator
from dataclasses import dataclass, field
from threading import Event

import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Lateness, Worker

GIVE_UP_S = 60.0


@dataclass
class Threaded:
    """A worker whose thread the test holds up."""

    go_on: Event = field(default_factory=Event)
    failures: Failures = field(default_factory=lambda: Failures(strict=False))

    def __post_init__(self) -> None:
        self.worker = Worker(self.failures, threads=True)

    def held(self, found: str) -> str:
        assert self.go_on.wait(GIVE_UP_S)
        return found

    def ask(self, *found: str) -> None:
        for each in found:
            assert self.worker.ask("search", 7, lambda each=each: self.held(each)) == []


@pytest.fixture
def threaded() -> Iterator[Threaded]:
    threaded = Threaded()
    yield threaded
    threaded.go_on.set()
    threaded.worker.close()


def fail() -> str:
    raise ValueError("told so")


def found(worker: Worker, wait: bool = False) -> list[str]:
    return [each.found for each in worker.take_finished(wait)]


def test_in_step_the_result_is_there_at_once_and_once_only() -> None:
    worker = Worker()
    assert worker.in_step
    assert worker.ask("search", 0, lambda: "found") == ["found"]
    assert not worker.waiting()
    assert found(worker, wait=True) == []


def test_nothing_is_waited_for_that_still_runs(threaded: Threaded) -> None:
    threaded.ask("first")
    assert not threaded.worker.in_step
    assert found(threaded.worker) == []
    assert threaded.worker.waiting("search") == threaded.worker.waiting() == 1
    assert not threaded.worker.waiting("another")


def test_results_are_taken_in_the_order_of_asking(threaded: Threaded) -> None:
    threaded.ask("first", "second", "third")
    threaded.go_on.set()
    assert found(threaded.worker, wait=True) == ["first", "second", "third"]
    assert not threaded.worker.waiting()


@pytest.mark.parametrize("threads", [True, False])
def test_what_fails_is_counted_and_costs_nothing_else(threads: bool) -> None:
    failures = Failures(strict=False)
    worker = Worker(failures, threads)
    answers = worker.ask("search", 7, fail) + worker.ask("search", 9, lambda: "found")
    answers += found(worker, wait=True)
    worker.close()
    assert answers == ["found"]
    assert [(kind.stage, kind.first_frame) for kind in failures.kinds] == [("search", 7)]


def test_full_memory_in_the_thread_is_raised_where_the_result_is_taken(threaded: Threaded) -> None:
    def too_large() -> str:
        raise MemoryError

    threaded.worker.ask("search", 7, too_large)
    with pytest.raises(MemoryError):
        found(threaded.worker, wait=True)


def test_what_is_dropped_is_waited_for_and_not_taken(threaded: Threaded) -> None:
    threaded.ask("first")
    threaded.worker.ask("another", 8, lambda: "kept")
    threaded.go_on.set()
    threaded.worker.drop("search")
    assert not threaded.worker.waiting("search")
    assert found(threaded.worker, wait=True) == ["kept"]


@pytest.mark.parametrize("threads", [True, False])
def test_long_work_runs_beside_what_is_asked_for(threads: bool) -> None:
    worker, go_on = Worker(threads=threads), Event()
    long = worker.start(lambda: go_on.wait(GIVE_UP_S))
    answers = worker.ask("search", 0, lambda: "found") + found(worker, wait=True)
    assert not long.done()
    go_on.set()
    assert long.result(GIVE_UP_S)
    assert answers == ["found"]
    worker.close()


def test_closing_drops_what_was_not_taken_and_ends_the_threads() -> None:
    worker = Worker(threads=True)
    worker.ask("search", 7, lambda: "found")
    worker.close()
    assert found(worker, wait=True) == []
    assert not worker.waiting()
    with pytest.raises(RuntimeError, match="shutdown"):
        worker.start(print)


def test_long_work_gives_way_to_late_tracking_after_its_result_is_there() -> None:
    slept, lateness = Event(), Lateness(lambda _: slept.wait(GIVE_UP_S))
    worker = Worker(threads=True, lateness=lateness)
    lateness.times = 1e6
    assert worker.start(lambda: "late").result(GIVE_UP_S) == "late"
    after = worker.start(lambda: "after the rest")
    with pytest.raises(concurrent.futures.TimeoutError):
        after.result(0.2)
    lateness.times = 0.0
    slept.set()
    assert after.result(GIVE_UP_S) == "after the rest"
    assert lateness.rests == 1
    worker.close()
