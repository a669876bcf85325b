"""Work that no pose waits for: at once in a replay, in a thread of a live run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from threading import Event

import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.tracking.side_work import SideWork

GIVE_UP_S = 60.0


@dataclass
class Threaded:
    """Side work in a thread that the test holds up."""

    go_on: Event = field(default_factory=Event)
    failures: Failures = field(default_factory=lambda: Failures(strict=False))
    taken: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.side_work = SideWork(self.failures, threaded=True)

    def held(self, found: str) -> str:
        assert self.go_on.wait(GIVE_UP_S)
        return found

    def ask(self, *found: str) -> None:
        for each in found:
            self.side_work.do("search", 7, lambda each=each: self.held(each), self.taken.append)


@pytest.fixture
def threaded() -> Iterator[Threaded]:
    threaded = Threaded()
    yield threaded
    threaded.go_on.set()
    threaded.side_work.close()


def fail() -> str:
    raise ValueError("told so")


def test_without_a_thread_the_result_is_taken_at_once() -> None:
    taken: list[str] = []
    side_work = SideWork()
    side_work.do("search", 0, lambda: "found", taken.append)
    assert taken == ["found"]
    assert not side_work.awaits("search")


def test_nothing_is_waited_for_that_still_runs(threaded: Threaded) -> None:
    threaded.ask("first")
    threaded.side_work.settle()
    assert threaded.taken == []
    assert threaded.side_work.awaits("search")


def test_results_are_taken_in_the_order_of_asking(threaded: Threaded) -> None:
    threaded.ask("first", "second", "third")
    threaded.go_on.set()
    threaded.side_work.settle(wait=True)
    assert threaded.taken == ["first", "second", "third"]
    assert not threaded.side_work.awaits("search")


@pytest.mark.parametrize("in_thread", [True, False])
def test_what_fails_is_counted_and_costs_nothing_else(in_thread: bool) -> None:
    failures, taken = Failures(strict=False), list[str]()
    side_work = SideWork(failures, in_thread)
    side_work.do("search", 7, fail, taken.append)
    side_work.do("taking", 8, lambda: "", lambda _: taken.append(fail()))
    side_work.do("search", 9, lambda: "found", taken.append)
    side_work.settle(wait=True)
    side_work.close()
    assert taken == ["found"]
    assert [(kind.stage, kind.first_frame) for kind in failures.kinds] == [
        ("search", 7), ("taking", 8)
    ]  # fmt: skip


def test_full_memory_in_the_thread_is_raised_where_the_result_is_taken(threaded: Threaded) -> None:
    def too_large() -> str:
        raise MemoryError

    threaded.side_work.do("search", 7, too_large, threaded.taken.append)
    with pytest.raises(MemoryError):
        threaded.side_work.settle(wait=True)


def test_closing_drops_what_was_not_taken() -> None:
    taken: list[str] = []
    side_work = SideWork(threaded=True)
    side_work.do("search", 7, lambda: "found", taken.append)
    side_work.close()
    side_work.settle(wait=True)
    assert taken == []
    assert not side_work.awaits("search")
