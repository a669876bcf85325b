"""The command that turns a dive into other formats: ``export``. Thin, like all of cli/."""

from __future__ import annotations

import json
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from aquaflow.cli.console import Json, progress_bars
from aquaflow.errors import InputError


class ExportFormat(str, Enum):
    """What a dive can be written as."""

    restored = "restored"
    laz = "laz"
    e57 = "e57"
    colmap = "colmap"
    nerfstudio = "nerfstudio"
    spz = "spz"


NAMES = {
    ExportFormat.restored: "restored",
    ExportFormat.laz: "points.laz",
    ExportFormat.e57: "points.e57",
    ExportFormat.colmap: "colmap",
    ExportFormat.nerfstudio: "nerfstudio",
    ExportFormat.spz: "map.spz",
}
"""Of what is written, in the dive's folder."""
OPTIONS = {
    ExportFormat.restored: {"--recording"},
    ExportFormat.laz: {"--water"},
    ExportFormat.e57: {"--water"},
    ExportFormat.colmap: {"--recording", "--restored"},
    ExportFormat.nerfstudio: {"--recording", "--restored"},
    ExportFormat.spz: {"--water"},
}
"""Which options a format knows, besides --out and --json."""

Progress = Callable[[int, int], None]


def register(app: typer.Typer) -> None:
    """Add the command to ``app``."""
    app.command("export")(export)


def export(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    format: Annotated[
        ExportFormat,
        typer.Option(
            help="restored: frames without their water. laz, e57: the map as points. "
            "colmap, nerfstudio: pictures, poses and points. spz: the map, compressed."
        ),
    ],
    recording: Annotated[
        Path | None,
        typer.Option(help="What was mapped; without it, pictures without water are drawn."),
    ] = None,
    restored: Annotated[
        bool, typer.Option("--restored", help="Pictures and points without water.")
    ] = False,
    water: Annotated[
        bool, typer.Option("--water", help="Colours as seen through the water, not without it.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="File or folder to write; else in the dive's.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a dive for other programs: pictures without water, points, posed pictures."""
    given = {"--recording": recording is not None, "--restored": restored, "--water": water}
    _refuse_others(format, given)
    target = out or dive / NAMES[format]
    with progress_bars(quiet=as_json) as bars:

        def progress(done: int, total: int) -> None:
            bars(format.value, done, total)

        if format is ExportFormat.restored:
            said, facts = _restored(dive, target, recording, progress)
        elif format in (ExportFormat.laz, ExportFormat.e57):
            said, facts = _points(dive, target, format, water, progress)
        elif format is ExportFormat.spz:
            said, facts = _compressed(dive, target, water)
        else:
            said, facts = _posed_pictures(dive, target, format, recording, restored, progress)
    if as_json:
        typer.echo(json.dumps({"out": str(target), **facts}))
    else:
        typer.echo(said)


def _refuse_others(format: ExportFormat, given: dict[str, bool]) -> None:
    unknown = [name for name, is_given in given.items() if is_given and name not in OPTIONS[format]]
    if unknown:
        raise InputError(f"--format {format.value} knows no {unknown[0]}; leave it out")


def _restored(
    dive: Path, folder: Path, recording: Path | None, progress: Progress
) -> tuple[str, dict[str, Any]]:
    from aquaflow.export.restored import export_restored

    count = export_restored(dive, folder, recording, progress)
    return f"Wrote {count} restored frames to {folder}.", {"frames": count}


def _points(
    dive: Path, path: Path, format: ExportFormat, water: bool, progress: Progress
) -> tuple[str, dict[str, Any]]:
    from aquaflow.export.e57 import write_e57
    from aquaflow.export.laz import write_laz
    from aquaflow.export.point_cloud import read_point_cloud

    cloud = read_point_cloud(dive, water)
    write = write_laz if format is ExportFormat.laz else write_e57
    write(path, cloud, progress)
    where = cloud.placement
    return f"Wrote {len(cloud)} points to {path}: {where.in_words()}.", {
        "points": len(cloud),
        "unit": where.unit,
        "epsg": where.epsg,
        "axes": where.in_words(),
    }


def _compressed(dive: Path, path: Path, water: bool) -> tuple[str, dict[str, Any]]:
    from aquaflow.export.spz import export_spz

    count, where = export_spz(dive, path, water)
    facts = {"gaussians": count, "unit": where.unit}
    return f"Wrote {count} Gaussians to {path}; lengths are {where.unit}, y is up.", facts


def _posed_pictures(
    dive: Path,
    folder: Path,
    format: ExportFormat,
    recording: Path | None,
    restored: bool,
    progress: Progress,
) -> tuple[str, dict[str, Any]]:
    from aquaflow.export.colmap import write_colmap
    from aquaflow.export.nerfstudio import write_nerfstudio
    from aquaflow.export.posed_pictures import export_posed_pictures

    write = write_colmap if format is ExportFormat.colmap else write_nerfstudio
    count = export_posed_pictures(dive, folder, write, recording, restored, progress)
    return f"Wrote {count} pictures with their poses to {folder}.", {"frames": count}
