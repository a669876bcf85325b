"""The command that compares two dives: ``change``. Thin, like all of cli/."""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aquaflow.base.errors import ArgumentError
from aquaflow.cli.console import Json, progress_bars

if TYPE_CHECKING:
    from aquaflow.survey.change.find_changes import Changes

MOST_RATE = 0.5
"""Largest --false: more than half of what is found would be nothing."""


def change(
    first: Annotated[
        str, typer.Option("--from", help="Earlier dive: its name in SITE, else its folder.")
    ],
    second: Annotated[str, typer.Option("--to", help="Later dive, likewise.")],
    site: Annotated[Path | None, typer.Argument(help="Site folder; else two dive folders.")] = None,
    transform: Annotated[
        Path | None, typer.Option(help="JSON with the similarity from --to's frame to --from's.")
    ] = None,
    cylinder: Annotated[
        float | None,
        typer.Option(help="m (map units without metres): radius of what is compared; else found."),
    ] = None,
    reach: Annotated[
        float | None, typer.Option(help="m, likewise: largest distance that is looked for.")
    ] = None,
    false: Annotated[
        float, typer.Option(help="Share of the places found changed that may not have.")
    ] = 0.05,
    out: Annotated[Path | None, typer.Option(help="Folder to write.")] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace the changes in --out.")] = False,
    as_json: Json = False,
) -> None:
    """Compare two dives of one place: what was gained, lost, moved, bleached."""
    _refuse_sizes({"--cylinder": cylinder, "--reach": reach})
    if not 0.0 < false <= MOST_RATE:
        raise ArgumentError(
            f"--false {false:g} is no share; give one above 0, {MOST_RATE:g} at most"
        )
    if site is not None and transform is not None:
        raise ArgumentError("a site knows how its dives lie; leave out --transform, or the site")
    if site is None:
        from aquaflow.base.storage.dive_status import refuse_without_map

        for name in (first, second):
            refuse_without_map(Path(name))
    names = f"{Path(first).resolve().name}_{Path(second).resolve().name}"
    target = out or (site or Path("out")) / f"change_{names}"
    from aquaflow.survey.change.find_changes import (
        ChangeSettings,
        find_changes,
        refuse_taken,
        write_changes,
    )
    from aquaflow.survey.change.frames import between, in_site

    refuse_taken(target, overwrite)
    if site is None:
        one, other = Path(first), Path(second)
        T_ab = between(one, other, transform)
    else:
        one, other, T_ab = in_site(site, first, second)
    asked = ChangeSettings(one, other, T_ab, false, cylinder, reach)
    with progress_bars(quiet=as_json) as bars, tempfile.TemporaryDirectory() as work:
        found = find_changes(asked, Path(work), bars)
        files = write_changes(target, found, overwrite)
    if as_json:
        written = {"out": str(target), "files": [str(file) for file in files]}
        typer.echo(json.dumps({**written, **found.to_json()}))
    else:
        typer.echo("\n".join([*_in_words(found), f"Wrote {target}: look at change.png."]))


def _refuse_sizes(given: dict[str, float | None]) -> None:
    for name, value in given.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise ArgumentError(f"{name} {value:g} is no length; give a positive one")


def _in_words(found: Changes) -> list[str]:
    """Lines for people."""
    data, unit = found.to_json(), found.ground.unit
    areas = data["areas"]
    both = sum(area for name, area in areas.items() if name != "not seen")
    level = data["level_of_detection_median"]
    lines = [
        f"{both:.3g} square {unit} are seen on both days, {areas['not seen']:.3g} on the first "
        f"alone; changes of {level:.2g} {unit} are detected (median, 95 %).",
    ]
    for row in data["patches"]:
        said = (
            f"{row['number']}. {row['class']} at {row['x']:.2f}, {row['y']:.2f}: "
            f"{row['area']:.3g} square {unit}"
        )
        if row["class"] == "bleached":
            said += f", {row['brightness_ratio']:.2f} times as bright"
        else:
            said += f", {row['distance']:+.3f} +- {row['distance_sigma']:.3f} {unit}"
        if row["moved"] is not None:
            said += (
                f"; with {row['partner']}: {row['moved']:.3f} +- {row['moved_sigma']:.3f} {unit}"
            )
        lines.append(said)
    if not data["patches"]:
        lines.append("Nothing changed.")
    return lines
