"""The command that gives a finished dive its metres by a marked length: ``measure scale``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aquaflow.cli.console import Json, progress_bars

if TYPE_CHECKING:
    from aquaflow.telemetry.known_lengths.known_length import KnownLength

RESCALED = (
    "The dive is in metres now: trajectory.tum, trajectory.csv, map.ply, map_clear.ply, "
    "medium.json, metrics.json, metric.json, coverage.*, the notes and the ranges of heldout/; "
    "reef_numbers.* were measured anew. report.html still shows map units; "
    "`aquaflow export report` does not."
)
RULER_SIGMA_M = 0.001
"""1 sigma of a length measured with a ruler."""


def scale(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    start: Annotated[str, typer.Option("--from", help="x,y in the picture, or x,y,z in the map.")],
    end: Annotated[str, typer.Option("--to", help="The other end, likewise.")],
    length: Annotated[float, typer.Option(help="m between the two points.")],
    frame: Annotated[int | None, typer.Option(help="Of the picture, for x,y.")] = None,
    sigma: Annotated[float, typer.Option(help="m, 1 sigma of the length.")] = RULER_SIGMA_M,
    as_json: Json = False,
) -> None:
    """Measure a known length in a dive's map, and so the metres of a map unit."""
    for name, value in (("length", length), ("sigma", sigma)):
        if not (math.isfinite(value) and value > 0.0):
            raise typer.BadParameter(f"--{name} must be a positive number of metres")
    from aquaflow.survey.measure.marked_length import keep_length
    from aquaflow.telemetry.known_lengths.known_lengths_file import FILE, read_known_lengths

    read_known_lengths(dive)  # a damaged file is found before the map is drawn
    known = _measure(dive, frame, _numbers("--from", start), _numbers("--to", end), length, sigma)
    with progress_bars(quiet=as_json) as bars:
        marked = keep_length(dive, known, bars)
    together, unchanged = marked.together, marked.unchanged
    if as_json:
        said = {
            "metres_per_unit": known.metres_per_unit, "relative_sigma": known.relative_sigma,
            "all_metres_per_unit": together.metres_per_unit,
            "all_relative_sigma": together.relative_sigma,
            "lengths": together.used, "rejected": len(together.rejected), "sub_map": known.sub_map,
            "rescaled": unchanged is None, "why_not": unchanged,
        }  # fmt: skip
        typer.echo(json.dumps(said))
        return
    typer.echo(marked.in_words())
    typer.echo(f"Written to {dive / FILE}.")
    typer.echo(unchanged or RESCALED)


def _measure(
    dive: Path,
    frame: int | None,
    start: tuple[float, ...],
    end: tuple[float, ...],
    length_m: float,
    sigma_m: float,
) -> KnownLength:
    """Raises typer.BadParameter for points that do not go together."""
    if len(start) != len(end):
        raise typer.BadParameter("--from and --to must both be x,y, or both x,y,z")
    if len(start) == 2 and frame is None:
        raise typer.BadParameter("points x,y need --frame, the number of the picture's frame")
    if len(start) == 3 and frame is not None:
        raise typer.BadParameter("points x,y,z are of the map; leave out --frame")
    from aquaflow.dive.dive import Dive
    from aquaflow.survey.measure.scale_bar import between_pixels, between_points  # loads torch

    if frame is None:
        ends = [(point[0], point[1], point[2]) for point in (start, end)]
        return between_points(Dive(dive), ends[0], ends[1], length_m, sigma_m)
    pixels = [(point[0], point[1]) for point in (start, end)]
    return between_pixels(Dive(dive), frame, pixels[0], pixels[1], length_m, sigma_m)


def _numbers(option: str, text: str) -> tuple[float, ...]:
    """Raises typer.BadParameter for anything but two or three numbers."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise typer.BadParameter(f"{option} {text!r} is neither x,y nor x,y,z; give numbers")
    return numbers
