"""The commands that make files of a dive: ``export``, report and video. Thin, as all of cli/."""

from __future__ import annotations

import json
import math
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.cli.console import GroupWithDefault, Json, WhiteBalanceOption, progress_bars
from aquaflow.survey.export.formats import (
    Exported,
    ExportRequest,
    choose_white,
    export_dive,
    make_parents,
    read_formats,
)

REPORT = "report.pdf"
"""In the dive's folder, where no other place is given."""


def export_group() -> typer.Typer:
    """The group ``export`` with its commands."""
    group = typer.Typer(cls=GroupWithDefault)
    group.command("export")(export)
    group.command()(report)
    group.command()(video)
    return group


def export(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    format: Annotated[
        str | None,
        typer.Option(
            help="One or more, with commas between. "
            "restored: frames without their water. laz, e57: the map as points. "
            "colmap, nerfstudio: pictures, poses and points. spz: the map, compressed. "
            "ply, obj, glb: the surface as triangles. "
            "ortho: the ground from straight above. dem: its heights. "
            "geotags, odm: where each picture was taken, a table for Metashape or OpenDroneMap. "
            "mcap: all of it for Foxglove and ROS 2."
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="All formats that the dive has.")] = False,
    recording: Annotated[
        Path | None,
        typer.Option(
            help="What was mapped, if it no longer lies where it was; without it, "
            "pictures without water are drawn."
        ),
    ] = None,
    restored: Annotated[
        bool, typer.Option("--restored", help="Pictures and points without water.")
    ] = False,
    water: Annotated[
        bool, typer.Option("--water", help="Colours as seen through the water, not without it.")
    ] = False,
    resolution: Annotated[
        float | None,
        typer.Option(
            help="m a pixel or voxel (map units without metres); without it, as in the pictures."
        ),
    ] = None,
    white_balance: WhiteBalanceOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write to, or a file with the format's ending; else the dive's folder."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a dive for other programs: pictures without water, points, posed pictures, maps."""
    if every == (format is not None):
        raise typer.BadParameter("give --format, or --all")
    formats = None if format is None else read_formats(format)
    request = ExportRequest(recording, restored, water, resolution, white_balance)
    from aquaflow.dive.dive import Dive

    made: list[Exported] = []
    try:
        with progress_bars(quiet=as_json) as bars:
            export_dive(Dive(dive), formats, out, request, bars, made.append)
    except InputError:
        for each in made:
            typer.echo(each.said, err=True)
        raise
    if as_json:
        facts = {each.format.value: each.facts for each in made}
        only = formats is not None and len(formats) == 1
        typer.echo(json.dumps(facts[made[0].format.value] if only else facts))
    else:
        typer.echo("\n".join(each.said for each in made))


def report(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    pdf: Annotated[Path | None, typer.Option(help="File; else report.pdf in the dive.")] = None,
    as_json: Json = False,
) -> None:
    """Write the report of a finished dive as one PDF, to print or to send."""
    if pdf is not None and pdf.suffix.lower() != ".pdf":
        raise ArgumentError(f"{pdf} does not end in .pdf; give the report a file of its own")
    from aquaflow.dive.dive import FRAMES, METRICS, Dive
    from aquaflow.survey.report.pdf import write_pdf
    from aquaflow.survey.report.report_of import report_of

    of = Dive(dive)
    of.require(FRAMES, METRICS)
    out = make_parents(pdf) if pdf else dive / REPORT
    pages = write_pdf(out, report_of(of))
    if as_json:
        typer.echo(json.dumps({"pdf": str(out), "pages": pages}))
        return
    typer.echo(f"Wrote {pages} pages to {out}.")


# --------------------------------------------------------------------------------------------------
# The command that makes a video of a dive: ``export video``. Thin, like all of cli/.


class VideoKind(str, Enum):
    """What a video can show."""

    side_by_side = "side-by-side"
    fly_through = "fly-through"
    restored = "restored"


VIDEO_OPTIONS = {
    VideoKind.side_by_side: {"--recording", "--white-balance"},
    VideoKind.fly_through: {"--water", "--seconds", "--width", "--white-balance"},
    VideoKind.restored: {"--recording", "--width", "--white-balance"},
}
"""Which options a kind knows, besides --out and --json."""
FLIGHT_S = 20.0
"""Length of a flight that nobody asked to be longer."""
LONGEST_FLIGHT_S = 3600.0
WIDTHS = (64, 8192)
"""px; as of the pictures that are mapped."""


def video(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    out: Annotated[Path, typer.Option(help="File to write, .mp4.")],
    kind: Annotated[
        VideoKind,
        typer.Option(
            help="side-by-side: camera and without water, with depth, heading, time and speed. "
            "fly-through: the map along a smooth path. restored: every frame of the recording "
            "without its water."
        ),
    ] = VideoKind.side_by_side,
    recording: Annotated[Path | None, typer.Option(help="What was mapped.")] = None,
    water: Annotated[
        bool, typer.Option("--water", help="Fly through the water, not without it.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(help="Length of a flight; 20.")] = None,
    width: Annotated[int | None, typer.Option(help="Pixels; else as mapped.")] = None,
    white_balance: WhiteBalanceOption = None,
    as_json: Json = False,
) -> None:
    """Make a video of a dive, for browsers: a flight through the map, or its pictures restored."""
    given = {
        "--recording": recording is not None, "--water": water, "--seconds": seconds is not None,
        "--width": width is not None, "--white-balance": white_balance is not None,
    }  # fmt: skip
    _refuse(kind, given, seconds, width)
    from aquaflow.dive.dive import MAP, Dive

    read = Dive(dive)
    read.require(MAP)
    if white_balance is not None:
        choose_white(read, white_balance, water)
    make_parents(out)
    with progress_bars(quiet=as_json) as bars:

        def progress(done: int, total: int) -> None:
            bars("video", done, total)

        facts: dict[str, Any]
        if kind is VideoKind.fly_through:
            from aquaflow.survey.video.fly_through import fly_through

            flight_s = FLIGHT_S if seconds is None else seconds
            count = fly_through(read, out, flight_s, water, width, progress)
            said, facts = f"Wrote a flight of {count} pictures to {out}.", {"frames": count}
        elif kind is VideoKind.side_by_side:
            from aquaflow.survey.video.every_frame import side_by_side

            count = side_by_side(read, out, recording or read.recording, progress)
            said, facts = f"Wrote {count} frames side by side to {out}.", {"frames": count}
        else:
            from aquaflow.survey.video.every_frame import restore_every_frame

            source = recording or read.recording
            if source is None:
                raise InputError("--kind restored needs --recording: a dive keeps no pictures")
            wrote = restore_every_frame(read, out, source, width, progress)
            said = f"Wrote {wrote.frames} frames to {out}, {wrote.restored} of them restored."
            facts = {"frames": wrote.frames, "restored": wrote.restored}
    typer.echo(json.dumps({"out": str(out), **facts}) if as_json else said)


def _refuse(
    kind: VideoKind, given: dict[str, bool], seconds: float | None, width: int | None
) -> None:
    unknown = [
        name for name, is_given in given.items() if is_given and name not in VIDEO_OPTIONS[kind]
    ]
    if unknown:
        raise ArgumentError(f"--kind {kind.value} knows no {unknown[0]}; leave it out")
    if seconds is not None and not (math.isfinite(seconds) and 0.0 < seconds <= LONGEST_FLIGHT_S):
        raise ArgumentError(f"--seconds {seconds:g} is no length; give 0 to {LONGEST_FLIGHT_S:.0f}")
    if width is not None and not WIDTHS[0] <= width <= WIDTHS[1]:
        raise ArgumentError(
            f"--width {width} is out of range; give {WIDTHS[0]} to {WIDTHS[1]} pixels"
        )
