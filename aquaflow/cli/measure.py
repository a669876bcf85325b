"""The command that measures in a finished dive: ``measure``. Thin, like all of cli/."""

from __future__ import annotations

import json
import math
import tempfile
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from aquaflow.base.errors import InputError
from aquaflow.cli.console import GroupWithDefault, Json, progress_bars
from aquaflow.cli.scale import scale

if TYPE_CHECKING:
    from aquaflow.dive.dive import Dive
    from aquaflow.survey.measure.answers import PointMeasurements
    from aquaflow.survey.measure.reef_numbers import ReefNumbers
    from aquaflow.survey.measure.units import LengthUnit


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
            raise InputError("--notes and --delete measure nothing; give no other options")
        _tend_notes(_with_map(dive), delete or [], as_json)
        return
    if cell is not None and not (math.isfinite(cell) and cell > 0.0):
        raise InputError(f"--cell {cell:g} is no size of a cell; give a positive one")
    if csv is not None and csv.suffix.lower() != ".csv":
        raise InputError(f"{csv} does not end in .csv; give the table a file of its own")
    if not point and (shape is not None or note is not None):
        raise InputError("--as and --note need points; give --point for each")
    read = _with_map(dive)
    from aquaflow.survey.measure.finished_dive import numbers_of_dive
    from aquaflow.survey.measure.reef_files import write_csv

    with progress_bars(quiet=as_json) as bars, tempfile.TemporaryDirectory() as work:
        found: PointMeasurements | ReefNumbers
        if point:
            found = _between(read, point, shape, cell, Path(work), bars)
        else:
            found = numbers_of_dive(read, Path(work), cell, bars)
    if note is not None:
        _pin(read, note, found)
    if csv is not None:
        write_csv(csv, found.rows())
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
    from aquaflow.survey.measure.quantity import Quantity
    from aquaflow.survey.measure.units import as_read

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
        said = [f"{what}: unknown, {why}." for what, why in found.missing.items()]
        if found.cell is not None:
            cell = read(found.cell, found.unit)
            said.append(
                f"On cells of {cell.value:.4g} {cell.unit}; vertical is {found.vertical}. Other "
                "cells have other numbers: compare dives on the same --cell."
            )
        if found.unit != "m":
            said.append(
                "The dive has no metres: lengths are in map units; `aquaflow measure scale` gives "
                "it some."
            )
    named = [(name, as_read(q, unit)) for name, q in named]
    width = max((len(name) for name, _ in named), default=0)
    lines = [
        f"{name:<{width}}  {q.in_words()}  (95 %: {q.low:.4g} to {q.high:.4g})" for name, q in named
    ]
    return "\n".join([*lines, *said])
