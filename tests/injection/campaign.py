"""All faults of a plan, in several processes; each result goes to a file as soon as it is there."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from . import harness, verdict
from .child import Ended, forked
from .dives import DIVES, Dive
from .plan import Task
from .table import BROKEN, NOT_MET, OWN_WAY, REFUSED, WHOLE, Result
from .verdict import Before
from .watch import Found, Moment, Site

TRIES = 4
"""A live dive sees other frames each time; where it misses a call, an earlier one is taken."""


def survey(
    recordings: Path, work: Path, dives: Sequence[Dive] = DIVES
) -> tuple[dict[tuple[str, Site], tuple[Dive, Found]], dict[str, Before]]:
    """What every dive reaches, and by name of the dive what it finds without a fault."""
    reached: dict[tuple[str, Site], tuple[Dive, Found]] = {}
    before: dict[str, Before] = {}
    for dive in dives:
        folder = work / dive.name.replace(" ", "_")
        ended, found = harness.counted(dive, recordings, folder)
        assert ended.code == 0, f"{dive.name} fails without a fault: {ended.err}"
        before[dive.name] = verdict.frames_of(folder / "dive", whole=dive.command == "map")
        for site, what in found.items():
            reached.setdefault((dive.command, site), (dive, what))
    return reached, before


def carry_out(
    tasks: Sequence[Task],
    recordings: Path,
    before: Mapping[str, Before],
    results: Path,
    workers: int,
) -> list[Result]:
    """Every task; the results, which ``results`` gets a line of JSON for each, as they come."""
    pids = []
    for number in range(workers):
        pid = os.fork()
        if pid == 0:
            _work(tasks[number::workers], recordings, before, results)
        pids.append(pid)
    for pid in pids:
        os.waitpid(pid, 0)
    lines = results.read_text().splitlines() if results.exists() else []
    done = [Result(**json.loads(line)) for line in lines]
    assert len(done) == len(tasks), f"{len(tasks) - len(done)} results are missing"
    return done


def _work(
    tasks: Sequence[Task], recordings: Path, before: Mapping[str, Before], results: Path
) -> None:
    try:
        for task in tasks:
            result = one(task, recordings, before[task.dive.name])
            with results.open("a") as stream:
                stream.write(json.dumps(asdict(result)) + "\n")
    finally:
        os._exit(0)


def one(task: Task, recordings: Path, before: Before) -> Result:
    """One dive with one fault, and how it ended."""
    for _ in range(TRIES):
        done = harness.injected(task.dive, task.strike, recordings)
        try:
            problems, outcome = _judged(task, done.met, done.ended, done.folder, before)
        finally:
            shutil.rmtree(done.folder, ignore_errors=True)
        if outcome != NOT_MET:
            break
        task = replace(task, strike=replace(task.strike, call=max(1, task.strike.call // 3)))
    site, kind = task.strike.site, task.strike.kind
    phase = "" if done.met is None else f"{done.met.phase}, frame {done.met.frame}"
    return Result(
        task.dive.name, task.dive.command, site.library, str(site), kind.value,
        task.strike.call, phase, outcome, problems, round(done.ended.cpu_s, 2),
    )  # fmt: skip


def _judged(
    task: Task, met: Moment | None, ended: Ended, folder: Path, before: Before
) -> tuple[list[str], str]:
    kind, moment = task.strike.kind, met or Moment()
    problems = verdict.exit_problems(kind, moment, ended)
    empty = verdict.stopped_empty(kind, moment, ended, folder / "dive")
    ended_whole = ended.code in verdict.ENDED and not empty
    at_start = met is not None and met.phase == "start"
    if not problems and ended_whole:
        problems = _looked_at(folder, before)
    if not problems and not ended_whole and not at_start:
        problems = verdict.row_problems(folder / "dive")
    if problems:
        return problems, BROKEN
    if met is None:
        return [], NOT_MET
    if ended_whole:
        return [], WHOLE
    return [], REFUSED if at_start else OWN_WAY


def _looked_at(folder: Path, before: Before) -> list[str]:
    """In a process of its own: reading a map starts threads, which a fork does not survive."""

    def look(told: dict[str, Any], save: Callable[[], None]) -> None:
        told["problems"] = verdict.folder_problems(folder / "dive", before)

    place = folder / "verdict"
    place.mkdir()
    looked = forked(look, place)
    problems: list[str] = looked.told.get("problems", [f"cannot be judged: {looked.err}"])
    return problems
