"""``aquaflow lab bench growth``: surveys of several lengths, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.lab.bench import machine
from aquaflow.lab.bench.growth.job import GrowthJob
from aquaflow.lab.bench.growth.picture import draw
from aquaflow.lab.bench.growth.table import caption, markdown
from aquaflow.lab.bench.runner import answer_of

WORKER = "aquaflow.lab.bench.growth.worker"
"""A survey has a process of its own, so that its memory is its own too."""
JSON_FILE, TABLE_FILE, PICTURE_FILE = "growth.json", "growth.md", "growth.png"
"""What a benchmark writes."""

FRAMES = (1000, 5000, 20_000)
"""Lengths of the surveys: 1.7, 8 and 33 minutes at 10 pictures a second."""
QUICK_FRAMES = (150, 300)
"""Long enough that a second line begins."""
LEAST_FRAMES = 50
"""The shortest survey in which a map is sure to start before half of it is over."""

Progress = Callable[[str, int, int | None], None]
Row = dict[str, Any]
Perform = Callable[[GrowthJob], Row]


def bench_growth(
    jobs: Sequence[GrowthJob], out: Path, progress: Progress, perform: Perform | None = None
) -> dict[str, Any]:
    """Run the jobs; writes the result, its table and its picture into ``out``.

    Raises:
        InputError: ``out`` cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {out}: {error.strerror}; give another --out") from error
    described, rows = machine.describe(), []
    progress("surveys", 0, len(jobs))
    for done, job in enumerate(jobs, 1):
        answer = (perform or _in_process)(job)
        rows.append({**asdict(job), "load": machine.load(), "failed": None, **answer})
        progress("surveys", done, len(jobs))
    result = {"machine": described, "rows": rows}
    write_json(out / JSON_FILE, result)
    with atomic_write(out / TABLE_FILE) as stream:
        stream.write(f"{caption(described, rows)}\n\n{markdown(rows)}".encode())
    draw(rows, out / PICTURE_FILE, caption(described, rows))
    return result


def jobs_of(
    frames: Sequence[int], width: int, preset: str, tracking_only: bool, out: Path
) -> list[GrowthJob]:
    """A job for each number of frames, the shortest first.

    Raises:
        InputError: a survey is too short for a map.
        ConfigError: there is no such preset.
    """
    if min(frames) < LEAST_FRAMES:
        raise InputError(f"--frames {min(frames)} is too short; give at least {LEAST_FRAMES}")
    jobs = [
        GrowthJob(count, width, str(out / f"dive_{count}"), preset, tracking_only)
        for count in sorted(set(frames))
    ]
    jobs[0].config()
    return jobs


def _in_process(job: GrowthJob) -> Row:
    return answer_of(WORKER, job.to_text())
