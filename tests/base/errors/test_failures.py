"""What a stage raises is counted and skipped; what has its own way to the user is let through."""

from __future__ import annotations

import errno
import json
import logging
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.base.errors import ConfigError, InputError, NotMappedError, printable
from aquaflow.base.errors.failures import RECENT_S, REPEATED, Failures
from aquaflow.dive.log import JsonLog

OWN = (
    Path(sys.modules["aquaflow.base.errors.failures"].__file__ or "").parents[2]
    / "tracking"
    / "invented.py"
)


def raise_in(path: Path | str, statement: str) -> None:
    """Run ``statement`` as if it stood in a function of the file ``path``."""
    scope: dict[str, object] = {"np": np, "cv2": cv2}
    exec(compile(f"def solve():\n    {statement}\n", str(path), "exec"), scope)
    scope["solve"]()  # type: ignore[operator]


def test_an_exception_is_counted_by_stage_kind_and_place() -> None:
    failures = Failures(strict=False)
    for index in (7, 8):
        with failures.contain("pose", index) as run:
            raise_in(OWN, "np.linalg.inv(np.zeros((2, 2)))")
        assert run.failed
    [kind] = failures.to_json()
    assert kind == {
        "stage": "pose",
        "error": "numpy.linalg.LinAlgError",
        "place": "aquaflow/tracking/invented.py: solve",
        "defect": False,
        "count": 2,
        "first_frame": 7,
    }
    assert failures.notes() == [
        "pose failed 2 times, first at frame 7 "
        "(numpy.linalg.LinAlgError in aquaflow/tracking/invented.py: solve)"
    ]


@pytest.mark.parametrize(
    "statement", ["assert False", "None.x", "[][0]", "{}['k']", "missing", "len(3)"]
)
def test_a_programming_error_of_ours_is_reported_as_such(
    statement: str, contained_defects: list[str]
) -> None:
    failures = Failures(strict=False)
    with failures.contain("pose"):
        raise_in(OWN, statement)
    [kind] = failures.kinds
    assert kind.defect
    assert "a defect in AquaFlow, please report it" in kind.note()
    assert failures.defects() == [kind.note()]
    assert failures.notes() == []
    contained_defects.clear()


def test_the_same_error_out_of_a_library_is_not_called_ours() -> None:
    failures = Failures(strict=False)
    with failures.contain("pose"):
        raise_in("/usr/lib/python3/site-packages/other/thing.py", "[][0]")
    with failures.contain("pose"):
        raise_in(OWN, "cv2.resize(None, (0, 0))")
    assert [kind.defect for kind in failures.kinds] == [False, False]


@pytest.mark.parametrize(
    "error",
    [
        KeyboardInterrupt(), SystemExit(2), MemoryError(), OSError(errno.ENOSPC, "full"),
        ConfigError("x"), NotMappedError("x"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 1 bytes"),
    ],
)  # fmt: skip
def test_interrupts_full_memory_full_disk_and_bad_settings_are_let_through(
    error: BaseException,
) -> None:
    failures = Failures(strict=False)
    with pytest.raises(type(error)), failures.contain("pose"):
        raise error
    assert failures.total == 0


def test_a_full_disk_is_let_through_also_as_the_sentence_that_was_made_of_it() -> None:
    failures = Failures(strict=False)
    with pytest.raises(InputError), failures.contain("report"):
        raise InputError("cannot write") from OSError(errno.ENOSPC, "full")
    with failures.contain("report") as run:
        raise InputError("cannot write") from OSError(errno.EIO, "broken")
    assert run.failed


def test_a_strict_run_lets_everything_through() -> None:
    with pytest.raises(ValueError, match="odd"), Failures(strict=True).contain("pose"):
        raise ValueError("odd")


def test_the_environment_says_whether_a_run_is_strict(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Failures().strict  # as all of our tests are
    monkeypatch.delenv("AQUAFLOW_STRICT")
    assert not Failures().strict


def test_the_traceback_is_logged_once_for_each_kind(tmp_path: Path) -> None:
    handler = JsonLog(tmp_path / "log.jsonl")
    handler.attach()
    failures = Failures(strict=False)
    for index in range(5):
        with failures.contain("loop search", index):
            raise ValueError("odd")
    handler.close()
    logging.getLogger("aquaflow").setLevel(logging.NOTSET)
    [line] = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert "ValueError: odd" in line["exception"]
    assert (line["event"], line["stage"], line["first_frame"]) == ("failure", "loop search", 0)


def test_a_stage_that_fails_again_and_again_is_named_until_it_works_for_a_minute() -> None:
    now = [0.0]
    failures = Failures(strict=False, now_s=lambda: now[0])
    for _ in range(REPEATED):
        assert failures.list_repeated() == []
        with failures.contain("water fit"):
            raise ValueError("odd")
    assert failures.list_repeated() == [f"water fit failed {REPEATED} times within 60 s"]
    now[0] = RECENT_S + 1.0
    assert failures.list_repeated() == []


def test_a_frames_reason_is_told_once() -> None:
    failures = Failures(strict=False)
    with failures.contain("pose", 12):
        raise ValueError("odd")
    assert (failures.reason(12) or "").startswith("pose failed: ValueError")
    assert failures.reason(12) is None


@given(st.lists(st.sampled_from(["pose", "water fit", "report"]), max_size=40))
def test_counts_add_up_whatever_fails(stages: list[str]) -> None:
    failures = Failures(strict=False)
    for stage in stages:
        with failures.contain(stage):
            raise ValueError("odd")
    assert failures.total == len(stages)
    assert {kind.stage for kind in failures.kinds} == set(stages)


def test_threads_may_fail_at_the_same_time() -> None:
    failures = Failures(strict=False)

    def fail() -> None:
        for _ in range(200):
            with failures.contain("pose"):
                raise ValueError("odd")

    threads = [threading.Thread(target=fail) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures.total == 800


def test_a_step_that_fails_is_done_once_more() -> None:
    failures, tries = Failures(strict=False), [0]

    def work() -> str:
        tries[0] += 1
        if tries[0] == 1:
            raise OSError(errno.EIO, "Input/output error")
        return "written"

    assert failures.attempt("writing", work) == "written"
    assert failures.total == 1


def test_a_step_that_fails_again_is_left() -> None:
    failures = Failures(strict=False)
    assert failures.attempt("writing", lambda: raise_in(OWN, "raise ValueError")) is None
    assert failures.total == 2


@pytest.mark.parametrize(
    ("name", "shown"),
    [("r\udce9ef", "r\\xe9ef"), ("a\nb", "a\\nb"), ("half \ud811", "half \\ud811"), ("岩", "岩")],
)
def test_any_name_can_be_shown(name: str, shown: str) -> None:
    assert printable(name) == shown
