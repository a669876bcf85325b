"""One queue for pictures, frames and samples: the newest win, and what gives way is counted."""

from __future__ import annotations

import threading

import pytest

from aquaflow.sources.newest import Newest
from tests.small_recording import GIVE_UP_S


def test_the_newest_wins_and_what_gives_way_is_let_go_and_counted() -> None:
    discard: list[int] = []
    queue: Newest[int] = Newest(discard=discard.append)
    for thing in range(4):
        queue.put(thing)
    assert queue.take(0.0) == 3
    assert queue.take(0.0) is None
    assert discard == [0, 1, 2]
    assert queue.overtaken == 3


def test_a_longer_one_gives_the_oldest_first() -> None:
    queue: Newest[int] = Newest(3)
    queue.put_all([1, 2, 3, 4])
    assert [queue.take(0.0) for _ in range(4)] == [2, 3, 4, None]
    assert queue.overtaken == 1


def test_what_is_held_at_the_end_can_be_taken_and_what_comes_later_is_let_go() -> None:
    discard: list[int] = []
    queue: Newest[int] = Newest(3, discard.append)
    queue.put_all([1, 2])
    queue.end()
    queue.put(3)
    assert not queue.ended
    assert [queue.take() for _ in range(3)] == [1, 2, None]
    assert queue.ended
    assert discard == [3]


def test_an_end_that_discards_lets_go_what_is_held() -> None:
    discard: list[int] = []
    queue: Newest[int] = Newest(discard=discard.append)
    queue.put(1)
    queue.end(discard=True)
    assert queue.ended
    assert queue.take() is None
    assert discard == [1]


@pytest.mark.parametrize("end", [False, True], ids=["thing", "end"])
def test_a_consumer_that_waits_without_a_limit_wakes(end: bool) -> None:
    queue: Newest[int] = Newest()
    found: list[int | None] = []
    consumer = threading.Thread(target=lambda: found.append(queue.take()), daemon=True)
    consumer.start()
    assert queue.wait_for_consumer(GIVE_UP_S)
    assert found == []
    if end:
        queue.end()
    else:
        queue.put(7)
    consumer.join(GIVE_UP_S)
    assert found == [None if end else 7]


def test_a_producer_waits_until_a_consumer_found_nothing() -> None:
    queue: Newest[int] = Newest()
    assert not queue.wait_for_consumer(0.0)
    queue.take(0.0)
    assert queue.wait_for_consumer(0.0)  # it will come again
    queue.put(1)
    assert not queue.wait_for_consumer(0.0)
    queue.take(0.0)
    assert not queue.wait_for_consumer(0.0)  # it has something to do
    queue.end()
    assert queue.wait_for_consumer(0.0)  # or the producer would wait without an end
