"""The command that turns a dive into other formats: ``export``. Thin, like all of cli/."""

from __future__ import annotations

import json
import math
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from aquaflow.cli.console import Json, progress_bars

if TYPE_CHECKING:
    from aquaflow.export.ortho.survey import Survey


class ExportFormat(str, Enum):
    """What a dive can be written as."""

    restored = "restored"
    ortho = "ortho"
    dem = "dem"


FORMATS = (
    "restored: frames without their water. ortho: the ground from straight above. dem: its heights."
)


def register(app: typer.Typer) -> None:
    """Add the command to ``app``."""
    app.command("export")(export)


def export(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    format: Annotated[ExportFormat, typer.Option(help=FORMATS)],
    recording: Annotated[
        Path | None,
        typer.Option(
            help="Of restored: what was mapped; without it, the map is drawn, not the pictures."
        ),
    ] = None,
    resolution: Annotated[
        float | None,
        typer.Option(help="Of ortho and dem: m a pixel (map units without metres); else found."),
    ] = None,
    water: Annotated[
        bool, typer.Option("--water", help="Of ortho: with the water, not without it.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder to write; else in the dive's.")] = None,
    as_json: Json = False,
) -> None:
    """Write a dive without its water: its frames, an orthophoto, or the heights of the ground."""
    _refuse_options_of_others(format, recording, resolution, water)
    folder = out or dive / format.value
    if format is ExportFormat.restored:
        _restored(dive, folder, recording, as_json)
    else:
        _survey(dive, folder, format, resolution, water, as_json)


def _refuse_options_of_others(
    format: ExportFormat, recording: Path | None, resolution: float | None, water: bool
) -> None:
    """Raises typer.BadParameter for an option that the format does not know, or a bad number."""
    if recording is not None and format is not ExportFormat.restored:
        raise typer.BadParameter("--recording goes with --format restored")
    if resolution is not None and format is ExportFormat.restored:
        raise typer.BadParameter("--resolution goes with --format ortho or dem")
    if water and format is not ExportFormat.ortho:
        raise typer.BadParameter("--water goes with --format ortho")
    if resolution is not None and not (math.isfinite(resolution) and resolution > 0.0):
        raise typer.BadParameter("--resolution must be a positive number")


def _restored(dive: Path, folder: Path, recording: Path | None, as_json: bool) -> None:
    from aquaflow.export.restored import export_restored

    with progress_bars(quiet=as_json) as progress:
        count = export_restored(
            dive, folder, recording, lambda done, total: progress("restore", done, total)
        )
    if as_json:
        typer.echo(json.dumps({"out": str(folder), "frames": count}))
    else:
        typer.echo(f"Wrote {count} restored frames to {folder}.")


def _survey(
    dive: Path,
    folder: Path,
    format: ExportFormat,
    resolution: float | None,
    water: bool,
    as_json: bool,
) -> None:
    from aquaflow.export.ortho.survey import export_survey

    kind: Literal["ortho", "dem"] = "dem" if format is ExportFormat.dem else "ortho"
    with progress_bars(quiet=as_json) as progress:
        survey = export_survey(dive, folder, kind, resolution, water, progress)
    if as_json:
        typer.echo(json.dumps(_as_json(survey)))
        return
    ground, names = survey.ground, " and ".join(str(path) for path in survey.files)
    typer.echo(
        f"Wrote {names}: {survey.width} x {survey.height} pixels of {survey.resolution:g} "
        f"{ground.unit}, {survey.covered:.0%} mapped."
    )
    typer.echo(f"Coordinates: {ground.axes}. Vertical: {ground.vertical}.")
    if kind == "dem":
        typer.echo(f"Heights are above {ground.height_zero}, {ground.unit}.")
    elif survey.water_range is not None:
        typer.echo(f"Seen through {survey.water_range:.3g} {ground.unit} of water.")


def _as_json(survey: Survey) -> dict[str, object]:
    ground = survey.ground
    return {
        "files": [str(path) for path in survey.files],
        "width": survey.width, "height": survey.height, "resolution": survey.resolution,
        "covered": survey.covered, "unit": ground.unit, "epsg": ground.epsg,
        "axes": ground.axes, "vertical": ground.vertical, "height_zero": ground.height_zero,
        "water_range": survey.water_range,
    }  # fmt: skip
