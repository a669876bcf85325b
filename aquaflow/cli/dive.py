"""``aquaflow dive``: what is done with the folder of a live dive. Thin, like all of cli/."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from aquaflow.cli.console import Json, progress_bars


def register(app: typer.Typer) -> None:
    """Add the commands to ``app``."""
    dive = typer.Typer(help="Finish a live dive that was cut off.", no_args_is_help=True)
    dive.command()(finish)
    app.add_typer(dive, name="dive")


def finish(
    folder: Annotated[Path, typer.Argument(help="Dive folder.", metavar="DIVE")],
    seconds: Annotated[
        float | None,
        typer.Option(min=0.0, help="Of refining; by default as in the dive's config.yaml."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Finish a live dive whose process was killed: refine, evaluate, write every file."""
    from aquaflow.cli.service import print_finished
    from aquaflow.live.finish import FinishedAlreadyError, finish_dive  # loads torch

    try:
        with progress_bars(quiet=as_json) as progress:
            finished = finish_dive(
                folder, seconds, lambda done, total: progress("refine", done, total)
            )
    except FinishedAlreadyError as said:
        typer.echo(json.dumps({"dive": str(folder)}) if as_json else f"{said}.")
        return
    print_finished(finished, as_json)
