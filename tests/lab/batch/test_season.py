"""The order of a batch: retries, room, a full disk, a cluster that is gone, Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.lab.batch.job import BatchJob, BatchOutcome
from aquaflow.lab.batch.season import End, Journal, Season, failed_jobs, run_season
from aquaflow.lab.batch.workers import LocalWorkers
from tests.lab.batch.seasons import read_journal


def job(name: str, size_bytes: int = 1, memory_mb: int = 100, threads: int = 1) -> BatchJob:
    return BatchJob(name, f"/{name}", size_bytes, "/site", "/cache", {}, None, threads, memory_mb)


class Scripted:
    """Workers that end jobs by a script: the states of each one's attempts."""

    def __init__(self, script: dict[str, list[str]], at_once: int = 1) -> None:
        self.script, self.at_once = script, at_once
        self.running: list[str] = []
        self.begun: list[str] = []
        self.closed = False

    def takes(self, job: BatchJob) -> bool:
        return len(self.running) < self.at_once

    def start(self, job: BatchJob) -> None:
        self.running.append(job.name)
        self.begun.append(job.name)

    def wait(self, timeout_s: float) -> tuple[str, BatchOutcome] | None:
        name = self.running.pop(0)
        state = self.script[name].pop(0)
        if state == "Ctrl-C":
            raise KeyboardInterrupt
        if state == "gone":
            raise InputError("the cluster is gone")
        return name, BatchOutcome(state, f"{state} it was")  # type: ignore[arg-type]

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., Season]:
    def run_it(workers: Scripted, *jobs: BatchJob, retries: int = 2) -> Season:
        journal = Journal(tmp_path / "batch.jsonl")
        season = run_season(jobs, workers, journal, retries, lambda done, total: None)
        journal.close()
        assert workers.closed
        return season

    return run_it


def test_a_dive_whose_process_died_is_tried_again_and_counts_once(
    run: Callable[..., Season], tmp_path: Path
) -> None:
    workers = Scripted({"a": ["lost", "lost", "done"], "b": ["done"]})
    season = run(workers, job("a"), job("b"))
    assert [season.outcomes[name].state for name in ("a", "b")] == ["done", "done"]
    assert workers.begun.count("a") == 3
    attempts = [line["attempt"] for line in read_journal(tmp_path / "batch.jsonl")
                if line["event"] == "started" and line["dive"] == "a"]  # fmt: skip
    assert attempts == [1, 2, 3]


def test_a_dive_that_always_dies_is_given_up_and_the_others_are_made(
    run: Callable[..., Season],
) -> None:
    workers = Scripted({"a": ["lost"] * 9, "b": ["done"]})
    season = run(workers, job("a"), job("b"), retries=1)
    assert workers.begun.count("a") == 2
    assert season.outcomes["b"].state == "done"
    assert [each.name for each in failed_jobs(season, [job("a"), job("b")])] == ["a"]
    assert season.outcomes["a"].sentence == "lost it was"


def test_what_would_fail_again_is_not_tried_again(run: Callable[..., Season]) -> None:
    workers = Scripted({"a": ["failed"]})
    assert run(workers, job("a")).outcomes["a"].state == "failed"
    assert workers.begun == ["a"]


def test_the_longest_dive_is_begun_first(run: Callable[..., Season]) -> None:
    workers = Scripted({"a": ["done"], "b": ["done"], "c": ["done"]})
    run(workers, job("a", 1), job("b", 3), job("c", 2))
    assert workers.begun == ["b", "c", "a"]


def test_after_a_full_disk_nothing_more_is_begun(run: Callable[..., Season]) -> None:
    workers = Scripted({"a": ["full"], "b": ["done"]})
    season = run(workers, job("a", 2), job("b", 1))
    assert workers.begun == ["a"]
    assert season.end is End.FULL_DISK
    assert len(failed_jobs(season, [job("a"), job("b")])) == 2


@pytest.mark.parametrize(("state", "end"), [("Ctrl-C", End.STOPPED), ("gone", End.NO_WORKERS)])
def test_an_end_before_its_time_keeps_what_is_finished(
    run: Callable[..., Season], tmp_path: Path, state: str, end: End
) -> None:
    season = run(Scripted({"a": ["done"], "b": [state]}), job("a", 2), job("b", 1))
    assert season.end is end
    assert list(season.outcomes) == ["a"]
    assert read_journal(tmp_path / "batch.jsonl")[-1]["event"] == "ended"


def test_a_job_is_taken_where_cores_memory_and_number_allow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(LocalWorkers, "_run", lambda self, job: None)
    workers = LocalWorkers(cores=3, memory_mb=1000)
    assert workers.takes(job("huge", memory_mb=99_999, threads=64))  # alone it always may
    workers.start(job("a", memory_mb=600))
    assert workers.takes(job("b", memory_mb=400, threads=2))
    assert not workers.takes(job("b", memory_mb=401))
    assert not workers.takes(job("b", memory_mb=1, threads=3))
    few = LocalWorkers(cores=3, memory_mb=1000, most=1)
    few.start(job("a"))
    assert not few.takes(job("b"))
