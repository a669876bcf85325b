"""The commands that measure in a dive: ``measure``, ``measure scale``, ``measure level``. Thin, as
all of cli/."""

from __future__ import annotations

import json
import math
import tempfile
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from aquaflow.base.errors import ArgumentError
from aquaflow.cli.console import GroupWithDefault, Json, progress_bars

if TYPE_CHECKING:
    from aquaflow.dive.dive import Dive
    from aquaflow.survey.measure.answers import PointMeasurements
    from aquaflow.survey.measure.quantity import LengthUnit
    from aquaflow.survey.measure.reef_numbers import ReefNumbers
    from aquaflow.telemetry.known_lengths.known_length import KnownLength


class PointShape(str, Enum):
    """What points are taken as."""

    line = "line"
    area = "area"
    profile = "profile"


class Units(str, Enum):
    """What lengths are printed in."""

    metres = "metres"
    feet = "feet"


def measure_group() -> typer.Typer:
    """The group ``measure`` with its commands."""
    group = typer.Typer(cls=GroupWithDefault)
    group.command("measure")(measure)
    group.command()(scale)
    group.command()(level)
    return group


def measure(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    point: Annotated[
        list[str] | None,
        typer.Option(
            help="x,y,z of the map, FRAME:u,v of a picture, or 63.4305N,10.3951E; once for each."
        ),
    ] = None,
    shape: Annotated[
        PointShape | None,
        typer.Option("--as", help="Two points are a line, more an area, unless this says else."),
    ] = None,
    cell: Annotated[
        float | None,
        typer.Option(help="m (map units without metres), cells of the ground; else found."),
    ] = None,
    note: Annotated[
        str | None, typer.Option(help="Pin the measurement to the map with this text.")
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="File for the numbers as a table.")] = None,
    notes: Annotated[
        bool, typer.Option("--notes", help="List the notes pinned to the map; measure nothing.")
    ] = False,
    delete: Annotated[
        list[str] | None,
        typer.Option(help="Key of a note to remove, as --notes lists it; once for each."),
    ] = None,
    units: Annotated[
        Units, typer.Option(help="Of what is printed; files and --json are in metres.")
    ] = Units.metres,
    as_json: Json = False,
) -> None:
    """Measure in a finished dive: the ground in numbers, or between points; or tend its notes."""
    if notes or delete:
        if point or any(each is not None for each in (shape, cell, note, csv)):
            raise ArgumentError("--notes and --delete measure nothing; give no other options")
        _tend_notes(_with_map(dive), delete or [], as_json)
        return
    if cell is not None and not (math.isfinite(cell) and cell > 0.0):
        raise ArgumentError(f"--cell {cell:g} is no size of a cell; give a positive one")
    if csv is not None and csv.suffix.lower() != ".csv":
        raise ArgumentError(f"{csv} does not end in .csv; give the table a file of its own")
    if not point and (shape is not None or note is not None):
        raise ArgumentError("--as and --note need points; give --point for each")
    read = _with_map(dive)
    from aquaflow.base.storage.table import write_table
    from aquaflow.survey.measure.finished_dive import numbers_of_dive

    with progress_bars(quiet=as_json) as bars, tempfile.TemporaryDirectory() as work:
        found: PointMeasurements | ReefNumbers
        if point:
            found = _between(read, point, shape, cell, Path(work), bars)
        else:
            found = numbers_of_dive(read, Path(work), cell, bars)
    if note is not None:
        _pin(read, note, found)
    if csv is not None:
        write_table(csv, found.rows())
    unit: LengthUnit = "feet" if units is Units.feet else "metres"
    typer.echo(json.dumps(found.to_json()) if as_json else _in_words(found, unit))


def _with_map(dive: Path) -> Dive:
    from aquaflow.dive.dive import MAP, Dive

    read = Dive(dive)
    read.require(MAP)
    return read


def _tend_notes(dive: Dive, delete: list[str], as_json: bool) -> None:
    """Remove the notes with these keys, and list what is left."""
    from aquaflow.survey.measure.notes import list_notes, read_notes, without, write_notes

    frame = dive.frame
    notes = read_notes(dive.path, frame)
    if delete:
        notes = without(notes, delete)
        write_notes(dive.path, notes, frame)
    if as_json:
        typer.echo(json.dumps({"unit": frame.unit, "notes": [note.to_json() for note in notes]}))
        return
    typer.echo("\n".join(list_notes(notes)) or "The dive has no notes.")


def _between(
    dive: Dive,
    texts: list[str],
    shape: PointShape | None,
    cell: float | None,
    work: Path,
    progress: Any,
) -> PointMeasurements:
    from aquaflow.survey.measure.asked import parse_point

    asked = [parse_point(text) for text in texts]
    from aquaflow.survey.measure.answers import answer  # loads torch

    return answer(dive, asked, None if shape is None else shape.value, work, cell, progress)


def _pin(dive: Dive, text: str, found: Any) -> None:
    from aquaflow.survey.measure.notes import new_note, read_notes, write_notes

    frame = dive.frame
    notes = read_notes(dive.path, frame)
    measured = found.to_json()["measured"]
    shape: Literal["Polygon", "LineString"] = "Polygon" if found.shape == "area" else "LineString"
    note = new_note(notes, text, shape, found.places, {"measured": measured})
    write_notes(dive.path, [*notes, note], frame)


def _in_words(found: Any, unit: LengthUnit) -> str:
    """Lines for people; of an answer or of reef numbers."""
    from aquaflow.survey.measure.quantity import Quantity, as_read

    def read(length: float, of: str) -> Quantity:
        return as_read(Quantity(length, 0.0, length, length, of), unit)

    if hasattr(found, "quantities"):
        named = [(name.replace("_", " "), q) for name, q in found.quantities.items()]
        said = list(found.notes)
        if found.profile is not None:
            heights = found.profile.height
            low, high = (read(float(h), found.profile.unit) for h in (heights.min(), heights.max()))
            said.append(
                f"{len(heights)} heights from {low.value:.3f} to {high.value:.3f} {low.unit}; "
                "--csv or --json gives them all."
            )
    else:
        named = [(each.label, each.quantity) for each in found.numbers]
        said = [f"{what.replace('_', ' ')}: unknown, {why}." for what, why in found.missing.items()]
        if found.cell is not None:
            cell = read(found.cell, found.unit)
            said.append(
                f"On cells of {cell.value:.4g} {cell.unit}; vertical is {found.vertical}. Other "
                "cells have other numbers: compare dives on the same --cell."
            )
    named = [(name, as_read(q, unit)) for name, q in named]
    width = max((len(name) for name, _ in named), default=0)
    lines = [
        f"{name:<{width}}  {q.in_words()}  (95 %: {q.interval_in_words()})" for name, q in named
    ]
    return "\n".join([*lines, *said])


# --------------------------------------------------------------------------------------------------
# The command that gives a finished dive its metres by a marked length: ``measure scale``.

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
        _refuse_not_positive(name, value, "metres")
    _with_map(dive)
    from aquaflow.survey.measure.scale_bar import keep_length
    from aquaflow.telemetry.known_lengths.known_length import FILE, read_known_lengths

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


def _refuse_not_positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise typer.BadParameter(f"--{name} must be a positive number of {unit}")


def _numbers(option: str, text: str) -> tuple[float, ...]:
    """Raises typer.BadParameter for anything but two or three numbers."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise typer.BadParameter(f"{option} {text!r} is neither x,y nor x,y,z; give numbers")
    return numbers


# --------------------------------------------------------------------------------------------------
# The command that gives a finished dive its vertical: ``measure level``.

LEVELLED = (
    "z points down now, and x along the initial heading, in trajectory.tum, trajectory.csv, "
    "map.ply, map_clear.ply, metrics.json, metric.json and the notes; overview.png was drawn and "
    "reef_numbers.* measured anew. report.html is still the old one; `aquaflow export report` "
    "makes it."
)
STEEPEST_DEG = 135.0
"""Below the horizon: a camera that looks down, and back."""


def level(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    point: Annotated[
        list[str] | None,
        typer.Option(
            help="On something level, such as the water surface or a tank's floor: x,y,z of the "
            "map or FRAME:u,v of a picture; three times at least."
        ),
    ] = None,
    camera_pitch: Annotated[
        float | None,
        typer.Option(help="Degrees that the cameras look below the horizon, mean; 90: down."),
    ] = None,
    sigma: Annotated[
        float | None,
        typer.Option(help="Degrees, 1 sigma of the pitch, or of how level it is; else 2."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say which way is down in a dive, so that it has a map from above, relief and slopes."""
    if (camera_pitch is None) == (not point):
        raise typer.BadParameter("give --point three times at least, or --camera-pitch")
    if camera_pitch is not None and not -STEEPEST_DEG <= camera_pitch <= STEEPEST_DEG:
        raise typer.BadParameter(f"--camera-pitch must lie within \u00b1{STEEPEST_DEG:g} degrees")
    if sigma is not None:
        _refuse_not_positive("sigma", sigma, "degrees")
    _with_map(dive)
    from aquaflow.survey.measure.asked import parse_point
    from aquaflow.survey.measure.levelling import (
        LEVEL_SIGMA_DEG,
        Vertical,
        make_level,
        of_pitch,
        of_points,
    )

    asked = [parse_point(text) for text in point or ()]
    known = LEVEL_SIGMA_DEG if sigma is None else sigma

    def find(read: Dive) -> Vertical:
        if camera_pitch is not None:
            return of_pitch(read, camera_pitch, known)
        return of_points(read, asked, known)

    with progress_bars(quiet=as_json) as bars:
        found = make_level(dive, find, bars)
    if as_json:
        report = found.report
        said = {"sigma_deg": found.sigma_deg, "source": report.source, "used": report.used}
        typer.echo(json.dumps(said))
        return
    typer.echo(f"{found.in_words()}\n{LEVELLED}")
