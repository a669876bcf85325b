"""A stage is timed and contained in one."""

from __future__ import annotations

import pytest

from aquaflow.base.errors.failures import Failures
from aquaflow.base.stages import Profiler, Stages


@pytest.fixture
def stages() -> Stages:
    return Stages(Profiler(), Failures(strict=False))


def test_what_a_stage_raises_is_counted_in_words_and_timed_all_the_same(stages: Stages) -> None:
    with stages("gate", 7) as run:
        raise ValueError("told so")
    assert run.failed
    assert [(kind.stage, kind.first_frame) for kind in stages.failures.kinds] == [("frame gate", 7)]
    assert stages.profiler.summary()["gate"]["count"] == 1


def test_a_stage_that_succeeds_is_timed_and_counts_no_failure(stages: Stages) -> None:
    with stages("coverage") as run, stages("overlay"):
        pass
    assert not run.failed
    assert stages.failures.kinds == []
    assert set(stages.profiler.summary()) == {"coverage", "overlay"}


def test_full_memory_comes_through_and_the_stage_has_ended(stages: Stages) -> None:
    with pytest.raises(MemoryError), stages("overlay"):
        raise MemoryError
    with stages("gate"):
        pass
    assert stages.profiler.summary()["overlay"]["count"] == 1
    assert stages.failures.kinds == []
