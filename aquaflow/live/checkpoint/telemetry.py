"""The telemetry of a dive before its resumption: read back from telemetry.jsonl."""

from __future__ import annotations

from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.run import DiveRun
from aquaflow.live.checkpoint.set_aside import SetAside
from aquaflow.live.clock_reading import ClockReading
from aquaflow.recordings.telemetry_lines import NAME, TelemetryLines, to_line


def cut_at_checkpoint(dive: Path, taken: ClockReading, now: ClockReading, aside: SetAside) -> None:
    """Take the samples of after the checkpoint out of the dive's telemetry, if the machine was
    started anew: without a clock that runs on, the dive's time of now may be theirs.

    Raises:
        InputError: the file cannot be read, or set aside.
    """
    path = dive / NAME
    if taken.is_of_the_boot_of(now) or not path.is_file():
        return
    try:
        if not any(sample.arrival_ns > taken.dive_ns for sample in TelemetryLines(path).samples()):
            return
        aside.copy(path, "samples of after the checkpoint, before the machine was started anew")
        with atomic_write(path) as stream:
            for sample in TelemetryLines(path).samples():
                if sample.arrival_ns <= taken.dive_ns:
                    stream.write(to_line(sample))
    except OSError as error:
        raise InputError(f"cannot resume with {path}: {error.strerror}") from error


def hear_again(run: DiveRun) -> None:
    """Give ``run``, whose tracking was restored, the telemetry of before, and the sub-maps the
    metric frames that follow from it; damaged lines cost themselves."""
    lines, metric = TelemetryLines(run.folder.path / NAME), run.slam.metric
    with run.slam.failures.contain("reading back of telemetry"):
        if lines.path.is_file():
            for sample in lines.samples():
                run.sample(sample)
    if lines.damaged:
        run.notes.append(f"{lines.damaged} damaged lines of {NAME} were left out")
    if metric.present:
        metric.resume(run.slam.graph.snapshot)
