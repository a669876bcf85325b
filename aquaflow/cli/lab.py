"""``aquaflow lab``: scenes with a known truth, measurements of AquaFlow itself, and its priors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow.cli.batch import batch
from aquaflow.cli.bench import ablate, bench_group
from aquaflow.cli.console import Json, progress_bars, table_console
from aquaflow.cli.prior import prior_group

if TYPE_CHECKING:
    from rich.console import Console

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
    as_json: Json = False,
) -> None:
    """Write a synthetic dive with its ground truth."""
    from pydantic import ValidationError

    from aquaflow.base.errors import ConfigError
    from aquaflow.lab.synthetic import SyntheticConfig, write_dive

    asked = {
        "scene": scene, "water": water, "frames": frames, "width": width, "height": height,
        "seed": seed, "display": display, "fish": fish, "arm": arm,
    }  # fmt: skip
    try:
        config = SyntheticConfig.model_validate({k: v for k, v in asked.items() if v is not None})
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"--{first['loc'][0]}: {first['msg'].lower()}") from error
    with progress_bars(quiet=as_json) as progress:
        write_dive(out, config, lambda done, total: progress("render", done, total))
    if as_json:
        typer.echo(json.dumps({"out": str(out), "frames": config.frames}))
    else:
        typer.echo(f"Wrote {config.frames} pictures with their truth to {out}.")


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
    from aquaflow.lab.evaluation.epipolar_error import evaluate_epipolar
    from aquaflow.lab.evaluation.naturalness import evaluate_naturalness
    from aquaflow.lab.evaluation.protocol import evaluate_dive
    from aquaflow.lab.evaluation.restoration import evaluate_restoration
    from aquaflow.lab.evaluation.summary import in_words

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
