"""Moments after which work is left out, by a clock that the test turns."""

from __future__ import annotations

from aquaflow.base.clocks.deadline import Deadline


class Clock:
    now = 50.0

    def __call__(self) -> float:
        return self.now


def test_a_deadline_is_over_when_its_time_has_passed() -> None:
    clock = Clock()
    deadline = Deadline(10.0, clock)
    assert (deadline.left_s, deadline.over, deadline.limited) == (10.0, False, True)
    clock.now += 10.0
    assert (deadline.left_s, deadline.over) == (0.0, True)
    clock.now += 5.0
    assert deadline.left_s == 0.0


def test_without_a_limit_it_is_never_over() -> None:
    clock = Clock()
    deadline = Deadline(None, clock)
    clock.now += 1e9
    assert not deadline.over
    assert not deadline.limited
    assert not deadline.share(0.1).limited
    assert deadline.within(3.0).left_s == 3.0


def test_the_earlier_of_two_counts_and_shares_are_of_what_is_left() -> None:
    clock = Clock()
    deadline = Deadline(10.0, clock)
    clock.now += 4.0
    assert deadline.within(None).left_s == 6.0
    assert deadline.within(9.0).left_s == 6.0
    assert deadline.within(2.0).left_s == 2.0
    assert deadline.share(0.5).left_s == 3.0
