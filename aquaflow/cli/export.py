"""The command that turns a dive into other formats: ``export``. Thin, like all of cli/."""

from __future__ import annotations

import json
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from aquaflow.cli.console import Json, progress_bars


class ExportFormat(str, Enum):
    """What a dive can be written as."""

    restored = "restored"


def register(app: typer.Typer) -> None:
    """Add the command to ``app``."""
    app.command("export")(export)


def export(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    format: Annotated[ExportFormat, typer.Option(help="restored: frames without their water.")],
    recording: Annotated[
        Path | None,
        typer.Option(help="What was mapped; without it, the map is drawn, not the pictures."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; else in the dive's.")] = None,
    as_json: Json = False,
) -> None:
    """Write the frames of a dive as they would look without water."""
    from aquaflow.export.restored import export_restored

    folder = out or dive / format.value
    with progress_bars(quiet=as_json) as progress:
        count = export_restored(
            dive, folder, recording, lambda done, total: progress("restore", done, total)
        )
    if as_json:
        typer.echo(json.dumps({"out": str(folder), "frames": count}))
    else:
        typer.echo(f"Wrote {count} restored frames to {folder}.")
