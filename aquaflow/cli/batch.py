"""The command that maps many recordings: ``lab batch``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aquaflow.base.errors.crash_report import FAILED, INTERRUPTED
from aquaflow.cli.console import PRESETS, Json, progress_bars, table_console

if TYPE_CHECKING:
    from aquaflow.lab.batch.batch import Batched
    from aquaflow.lab.batch.job import BatchOutcome

POOR_RESULT = 3
"""Exit status where every dive was written, and some with warnings, as of `map`."""


def batch(
    dives: Annotated[str, typer.Argument(help="Folder of recordings, its URL, or a list file.")],
    out: Annotated[str, typer.Option(help="Site to write: a folder, or s3://bucket/site.")],
    config: Annotated[Path | None, typer.Option(help="YAML config; see `aquaflow config`.")] = None,
    preset: Annotated[str | None, typer.Option(help=PRESETS)] = None,
    calib: Annotated[Path | None, typer.Option(help="camera.yaml for all of them.")] = None,
    every: Annotated[int | None, typer.Option(help="Use every n-th frame.")] = None,
    width: Annotated[int | None, typer.Option(help="Width in pixels to map at.")] = None,
    threads: Annotated[int | None, typer.Option(help="Of each dive; default 1.")] = None,
    tracking_only: Annotated[bool, typer.Option(help="Trajectories without maps.")] = False,
    jobs: Annotated[int | None, typer.Option(help="Dives at once; else as many as fit.")] = None,
    memory: Annotated[
        float | None, typer.Option(help="GB for all dives at once; else 80 % of what is free.")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(help="Ray cluster: auto | host:6379 | ray://host:10001")
    ] = None,
    retries: Annotated[int, typer.Option(help="Further attempts where a process died.")] = 2,
    cache: Annotated[
        Path | None, typer.Option(help="Local folder for what an object store has or gets.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Map many recordings, each into a dive of its own; go on where an earlier batch ended."""
    from aquaflow.config.batch import BatchConfig
    from aquaflow.config.presets import load_configured
    from aquaflow.config.stage import validate

    settings = load_configured(
        config,
        preset,
        {
            "threads": threads,
            "source": {"every": every, "width": width},
            "mapping": {"enabled": False if tracking_only else None},
        },
        "command line",
    )
    asked = validate(
        BatchConfig,
        {
            "jobs": jobs, "memory_gb": memory, "retries": retries, "cluster": cluster,
            "cache": cache,
        },
        "command line",
    )  # fmt: skip
    from aquaflow.lab.batch.batch import run_batch
    from aquaflow.lab.batch.membership import Sites
    from aquaflow.survey.site.adding import add_to_site
    from aquaflow.survey.site.manifest import is_site

    with progress_bars(quiet=as_json) as progress:
        batched = run_batch(
            dives, out, settings, _content(calib), asked, progress, Sites(is_site, add_to_site)
        )
    if as_json:
        typer.echo(json.dumps(_as_json(batched, out)))
    else:
        _print_table(batched)
    raise typer.Exit(_exit_code(batched))


def _content(calib: Path | None) -> str | None:
    """The text of a calibration that is one."""
    if calib is None:
        return None
    from aquaflow.geometry.camera import load_camera

    load_camera(calib)
    return calib.read_text(encoding="utf-8")


def _exit_code(batched: Batched) -> int:
    from aquaflow.lab.batch.season import End, failed_jobs

    if batched.season.end is End.STOPPED:
        return INTERRUPTED
    if failed_jobs(batched.season, batched.jobs):
        return FAILED
    poor = any(each.state == "poor" for each in batched.season.outcomes.values())
    return POOR_RESULT if poor else 0


def _as_json(batched: Batched, out: str) -> dict[str, object]:
    from aquaflow.lab.batch.season import failed_jobs

    outcomes = batched.season.outcomes
    return {
        "site": out,
        "end": batched.season.reason or batched.season.end.value,
        "dives": {
            job.name: outcomes[job.name].to_json() if job.name in outcomes else None
            for job in batched.jobs
        },
        "notes": batched.notes,
        "failed": [job.name for job in failed_jobs(batched.season, batched.jobs)],
    }


def _print_table(batched: Batched) -> None:
    from rich.markup import escape
    from rich.table import Table

    from aquaflow.lab.batch.season import End, failed_jobs

    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("dive", "state", "frames", "posed", "PSNR dB", "CPU s", "MB", "node"):
        right = title not in ("dive", "state", "node")
        table.add_column(title, justify="right" if right else "left")
    outcomes = batched.season.outcomes
    for job in batched.jobs:
        table.add_row(escape(job.name), *_cells(outcomes.get(job.name)))
    table_console().print(table)
    for job in batched.jobs:
        outcome = outcomes.get(job.name)
        if outcome is not None and outcome.sentence:
            typer.echo(f"{job.name}: {outcome.sentence}")
    for note in batched.notes:
        typer.echo(f"Note: {note}.")
    season = batched.season
    missing = len(failed_jobs(season, batched.jobs))
    typer.echo(f"{len(batched.jobs) - missing} of {len(batched.jobs)} dives are there.")
    if season.end is not End.ALL:
        why = season.reason or f"{season.end.value}; give the same command again to go on"
        typer.echo(f"The batch ended early: {why}.")


def _cells(outcome: BatchOutcome | None) -> list[str]:
    if outcome is None:
        return ["not made", *[""] * 6]
    state = "there before" if outcome.earlier else outcome.state
    return [
        state,
        _number(outcome.frames),
        _number(outcome.tracked),
        _number(outcome.psnr, ".2f"),
        _number(outcome.cpu_s, ".0f"),
        _number(outcome.peak_mb, ".0f"),
        outcome.node,
    ]


def _number(value: float | None, form: str = "d") -> str:
    return "" if value is None else format(value, form)
