"""What says that the computer's clock was set: a time server, or a clock with a battery."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.base.clocks import wall as computer
from aquaflow.base.clocks.wall import SYNCHRONISED, clock_is_set, kernel_is_synchronised

NOW_S = 1_795_365_000.0


def machine(root: Path, battery: str | None = None, heard: bool = False) -> Path:
    if battery is not None:
        clock = root / "sys/class/rtc/rtc0/since_epoch"
        clock.parent.mkdir(parents=True)
        clock.write_text(battery)
    if heard:
        (root / SYNCHRONISED).parent.mkdir(parents=True)
        (root / SYNCHRONISED).touch()
    return root


@pytest.mark.parametrize(
    ("battery", "heard", "is_set"),
    [
        (None, False, False),
        (None, True, True),
        ("1795365001\n", False, True),  # the boot took the time from it
        ("1234\n", False, False),  # it lost its battery, and a file set the clock
        ("broken\n", False, False),
        ("1234\n", True, True),
    ],
)
def test_a_clock_is_set_by_a_server_or_a_battery_that_agrees(
    tmp_path: Path, battery: str | None, heard: bool, is_set: bool
) -> None:
    assert clock_is_set(machine(tmp_path, battery, heard), lambda: NOW_S) is is_set


def test_the_kernel_is_asked_and_a_sandbox_that_forbids_it_says_no(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Libc:
        def __init__(self, answer: int) -> None:
            self.answer = answer

        def adjtimex(self, _: object) -> int:
            return self.answer

    assert kernel_is_synchronised() in (True, False)  # of this machine: the call works
    for answer, said in ((0, True), (4, True), (5, False), (-1, False)):
        monkeypatch.setattr(computer.ctypes, "CDLL", lambda _, answer=answer: Libc(answer))
        assert kernel_is_synchronised() is said
    monkeypatch.setattr(computer.ctypes, "CDLL", lambda _: object())
    assert not kernel_is_synchronised()
