"""``aquaflow lab``: scenes with a known truth, measurements of AquaFlow itself, and its priors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow.base.errors.crash_report import FAILED, INTERRUPTED
from aquaflow.cli.bench import ablate, bench_group
from aquaflow.cli.console import PRESETS, Json, progress_bars, table_console
from aquaflow.cli.prior import prior_group

if TYPE_CHECKING:
    from rich.console import Console

    from aquaflow.lab.batch.batch import Batched
    from aquaflow.lab.batch.job import BatchOutcome
    from aquaflow.lab.stress.suite import Result


def lab_group() -> typer.Typer:
    """The group ``lab`` with its commands."""
    lab = typer.Typer(no_args_is_help=True)
    for command in (synth, evaluate, ablate, stress, batch):
        lab.command()(command)
    lab.add_typer(bench_group(), name="bench")
    lab.add_typer(prior_group(), name="prior")
    return lab


def synth(
    out: Annotated[Path, typer.Argument(help="Folder to write.")],
    scene: Annotated[
        str, typer.Option(help="reef | flat_sand | wall | pipe | pool | survey | hull | net")
    ] = "reef",
    water: Annotated[str | None, typer.Option(help="Water type, such as coastal_1C.")] = None,
    frames: Annotated[int | None, typer.Option(help="Number of pictures.")] = None,
    width: Annotated[int | None, typer.Option(help="Pixels.")] = None,
    height: Annotated[int | None, typer.Option(help="Pixels.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of every random draw.")] = 0,
    display: Annotated[
        str | None, typer.Option(help="Burned in: clock | clock_and_crosshair | panel")
    ] = None,
    fish: Annotated[int, typer.Option(help="Fish that cross the view, each once.")] = 0,
    arm: Annotated[
        bool, typer.Option("--arm", help="The vehicle's arm is in the picture.")
    ] = False,
    lamps: Annotated[
        float | None, typer.Option(help="Lamps by the camera; the share of daylight, 0 to 1.")
    ] = None,
    range_effects: Annotated[
        bool,
        typer.Option("--range-effects", help="Blur and colour that no medium explains, by range."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a synthetic dive with its ground truth."""
    from pydantic import ValidationError

    from aquaflow.base.errors import ArgumentError, words_of
    from aquaflow.lab.synthetic.config import SyntheticConfig
    from aquaflow.lab.synthetic.dive import POSITIONS, write_dive

    asked = {
        "scene": scene, "water": water, "frames": frames, "width": width, "height": height,
        "seed": seed, "display": display, "fish": fish, "arm": arm,
        "lamps": None if lamps is None else {"ambient": lamps},
        "range_effects": {} if range_effects else None,
    }  # fmt: skip
    try:
        config = SyntheticConfig.model_validate({k: v for k, v in asked.items() if v is not None})
    except ValidationError as error:
        first = error.errors()[0]
        raise ArgumentError(f"--{first['loc'][0]}: {words_of(first['msg'])}") from error
    with progress_bars(quiet=as_json) as progress:
        write_dive(out, config, lambda done, total: progress("render", done, total))
    if as_json:
        typer.echo(json.dumps({"out": str(out), "frames": config.frames}))
    else:
        typer.echo(
            f"Wrote {config.frames} pictures with their truth to {out}.\nTo map it on the earth: "
            f"--telemetry {out / POSITIONS} --telemetry-offset 0"
        )


def evaluate(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    truth: Annotated[
        Path | None, typer.Option(help="poses.tum, a synthetic dive, or a table of positions.")
    ] = None,
    clean: Annotated[
        Path | None, typer.Option(help="The same recording without water, for restored views.")
    ] = None,
    clean_crop: Annotated[str | None, typer.Option(help="Crop of --clean, such as right.")] = None,
    recording: Annotated[
        Path | None, typer.Option(help="What was mapped: do its pictures agree with the poses?")
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure a dive: colours of restored views, and what the truth allows to compare."""
    from aquaflow.base.errors import InputError
    from aquaflow.base.storage.dive_status import refuse_unfinished
    from aquaflow.config import SourceConfig
    from aquaflow.config.stage import COMMAND_LINE, validate
    from aquaflow.lab.evaluation.epipolar_error import evaluate_epipolar
    from aquaflow.lab.evaluation.naturalness import evaluate_naturalness
    from aquaflow.lab.evaluation.protocol import evaluate_dive
    from aquaflow.lab.evaluation.restoration import evaluate_restoration
    from aquaflow.lab.evaluation.summary import in_words

    validate(SourceConfig, {"crop": clean_crop}, COMMAND_LINE)
    refuse_unfinished(dive)
    natural = evaluate_naturalness(dive)
    if truth is None and clean is None and recording is None and natural is None:
        raise InputError(
            f"{dive} has no restored held-out views to look at; give --truth, --clean or "
            "--recording"
        )
    result: dict[str, Any] = {"naturalness": natural and natural.to_json()}
    if truth is not None:
        result |= evaluate_dive(dive, truth).to_json()
    if clean is not None:
        result["restoration"] = evaluate_restoration(dive, clean, clean_crop).to_json()
    if recording is not None:
        result["epipolar"] = evaluate_epipolar(dive, recording, truth).to_json()
    if as_json:
        typer.echo(json.dumps(result))
    else:
        typer.echo("\n".join(in_words(result)))


def stress(
    family: Annotated[
        str | None, typer.Option(help="Only this family, such as images or solvers.")
    ] = None,
    case: Annotated[str | None, typer.Option(help="Only the case of this name.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of every random draw.")] = 0,
    long: Annotated[bool, typer.Option("--long", help="Also the cases that take minutes.")] = False,
    as_json: Json = False,
) -> None:
    """Feed AquaFlow what no sane dive has, and see that it stays finite and keeps its word."""
    from rich.console import Console

    from aquaflow.lab.stress.suite import cases, on_few_threads, run_cases

    chosen = cases(family, case, long)
    screen = Console(stderr=True)
    with on_few_threads(), screen.status("stress") as status:
        results = run_cases(
            chosen, seed, lambda done, i, n: status.update(f"{i} of {n}: {done.case.name}")
        )
    if as_json:
        typer.echo(json.dumps({"cases": [result.to_json() for result in results]}))
    else:
        _print(results, table_console())
    if not all(result.outcome.passed for result in results):
        raise typer.Exit(1)


def _print(results: list[Result], console: Console) -> None:
    from rich.table import Table

    table = Table()
    for title in ("case", "family", "outcome", "worst value"):
        table.add_column(title, no_wrap=True)
    table.add_column("guard", overflow="fold")
    for result in results:
        outcome = result.outcome
        verdict = "[green]pass[/]" if outcome.passed else "[red]FAIL[/]"
        table.add_row(
            result.case.name, result.case.family, verdict, f"{outcome.worst:.3g}", result.case.guard
        )
    console.print(table)
    failed = [result for result in results if not result.outcome.passed]
    console.print(f"{len(results) - len(failed)} of {len(results)} cases pass.")
    for result in failed:
        console.print(f"{result.case.name}: {result.outcome.detail}", markup=False)
        console.print(f"  reproduce with: {result.command}", markup=False)


# --------------------------------------------------------------------------------------------------
# The command that maps many recordings: ``lab batch``.

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
    from aquaflow.config.presets import load_configured
    from aquaflow.config.stage import COMMAND_LINE, validate
    from aquaflow.lab.batch.job import BatchConfig

    settings = load_configured(
        config,
        preset,
        {
            "threads": threads,
            "source": {"every": every, "width": width},
            "mapping": {"enabled": False if tracking_only else None},
        },
        COMMAND_LINE,
    )
    asked = validate(
        BatchConfig,
        {
            "jobs": jobs, "memory_gb": memory, "retries": retries, "cluster": cluster,
            "cache": cache,
        },
        COMMAND_LINE,
    )  # fmt: skip
    from aquaflow.lab.batch.batch import run_batch
    from aquaflow.lab.batch.site import Sites
    from aquaflow.survey.site.manifest import is_site
    from aquaflow.survey.site.merging import add_to_site

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
