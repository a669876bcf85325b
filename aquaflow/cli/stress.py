"""``aquaflow stress``: numerical stability as a table of cases."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from aquaflow.cli.console import Json, table_console

if TYPE_CHECKING:
    from rich.console import Console

    from aquaflow.lab.stress.suite import Result


def register(app: typer.Typer) -> None:
    """Add the command to ``app``."""
    app.command()(stress)


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
