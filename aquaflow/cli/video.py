"""The command that makes a video of a dive: ``export video``. Thin, like all of cli/."""

from __future__ import annotations

import json
import math
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from aquaflow.base.errors import InputError
from aquaflow.cli.console import Json, progress_bars


class VideoKind(str, Enum):
    """What a video can show."""

    side_by_side = "side-by-side"
    fly_through = "fly-through"
    restored = "restored"


OPTIONS = {
    VideoKind.side_by_side: {"--recording"},
    VideoKind.fly_through: {"--water", "--seconds", "--width"},
    VideoKind.restored: {"--recording", "--width"},
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
    as_json: Json = False,
) -> None:
    """Make a video of a dive, for browsers: a flight through the map, or its pictures restored."""
    given = {
        "--recording": recording is not None, "--water": water, "--seconds": seconds is not None,
        "--width": width is not None,
    }  # fmt: skip
    _refuse(kind, given, seconds, width)
    from aquaflow.dive.dive import MAP, Dive

    read = Dive(dive)
    read.require(MAP)
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
            from aquaflow.survey.video.side_by_side import side_by_side

            count = side_by_side(read, out, recording, progress)
            said, facts = f"Wrote {count} frames side by side to {out}.", {"frames": count}
        else:
            from aquaflow.survey.video.every_frame import restore_every_frame

            if recording is None:
                raise InputError("--kind restored needs --recording: a dive keeps no pictures")
            wrote = restore_every_frame(read, out, recording, width, progress)
            said = f"Wrote {wrote.frames} frames to {out}, {wrote.restored} of them restored."
            facts = {"frames": wrote.frames, "restored": wrote.restored}
    typer.echo(json.dumps({"out": str(out), **facts}) if as_json else said)


def _refuse(
    kind: VideoKind, given: dict[str, bool], seconds: float | None, width: int | None
) -> None:
    unknown = [name for name, is_given in given.items() if is_given and name not in OPTIONS[kind]]
    if unknown:
        raise InputError(f"--kind {kind.value} knows no {unknown[0]}; leave it out")
    if seconds is not None and not (math.isfinite(seconds) and 0.0 < seconds <= LONGEST_FLIGHT_S):
        raise InputError(f"--seconds {seconds:g} is no length; give 0 to {LONGEST_FLIGHT_S:.0f}")
    if width is not None and not WIDTHS[0] <= width <= WIDTHS[1]:
        raise InputError(f"--width {width} is out of range; give {WIDTHS[0]} to {WIDTHS[1]} pixels")
