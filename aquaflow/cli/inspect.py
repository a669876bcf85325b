"""The command that says what would be read of a recording: ``inspect``."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow.base.errors import InputError, printable
from aquaflow.cli.console import Json

if TYPE_CHECKING:
    from aquaflow.sources import RecordedCamera
    from aquaflow.sources.telemetry_input import TelemetryInput
    from aquaflow.types import Frame

MOST_FRAMES = 30
"""Pictures that are read: a second or a few."""
MOST_SAMPLES = 2000
"""Samples of telemetry that are read."""


def inspect(
    source: Annotated[Path, typer.Argument(help="Folder of pictures, video, bag, or log.")],
    topic: Annotated[str | None, typer.Option(help="Picture topic of a bag.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames/s of a folder.")] = None,
    as_json: Json = False,
) -> None:
    """Say what would be read of a recording, what would be assumed, and what is odd."""
    from aquaflow.sources import camera_reader, open_recording, telemetry_reader
    from aquaflow.sources.telemetry_input import open_telemetry

    found: dict[str, Any] = {"source": str(source)}
    reader = telemetry_reader(source)
    if camera_reader(source) is not None or reader is None:
        recording = open_recording(source, fps, topic)
        try:
            found |= _pictures(recording)
        finally:
            recording.close()
    if reader is not None:
        found["telemetry"] = _telemetry(open_telemetry(source, fps=fps, topic=topic))
    if as_json:
        typer.echo(json.dumps(found))
        return
    found |= {f"{name} from": said for name, said in found.pop("sources", {}).items()}
    for name, value in found.items():
        for each in value if isinstance(value, list) else [value]:
            typer.echo(printable(f"{name:>16}  {_in_words(each)}"))


def _pictures(recording: RecordedCamera) -> dict[str, Any]:
    from aquaflow.sources import sources_of
    from aquaflow.sources.picture_check import oddities
    from aquaflow.types import Frame

    read = list(islice(recording.frames(), MOST_FRAMES))
    frames: list[Frame] = [each for each in read if isinstance(each, Frame)]
    found: dict[str, Any] = {"pictures": recording.frame_count or f"at least {len(read)}"}
    odd = [each.reason for each in read if not isinstance(each, Frame)][:3]
    if frames:
        height, width = frames[0].image.shape[:2]
        found["size"] = f"{width} x {height}"
        span_s = 1e-9 * (frames[-1].t_ns - frames[0].t_ns)
        if span_s > 0.0:
            found["rate_hz"] = round((frames[-1].index - frames[0].index) / span_s, 3)
        camera = recording.camera
        found["calibration"] = (
            "none: a focal length is assumed and refined"
            if camera is None
            else f"fx {camera.fx:.1f} px of {camera.width}, {camera.distortion_model}"
        )
        odd += oddities([frame.image for frame in frames])
    sources = sources_of(recording)
    found["sources"] = sources
    found["notes"] = [note for note in recording.notes if note not in sources.values()]
    found["odd"] = odd
    return found


def _telemetry(opened: TelemetryInput) -> list[dict[str, Any]]:
    kinds: dict[str, list[int]] = {}
    read = 0
    try:
        for sample in islice(opened.synchronised[0].samples(), MOST_SAMPLES):
            kinds.setdefault(type(sample).__name__, []).append(sample.t_ns)
            read += 1
    except InputError as error:
        return [{"problem": str(error)}]
    finally:
        opened.close()
    whole = read < MOST_SAMPLES
    return [
        {
            "kind": kind, "read": len(times), "from_s": min(times) * 1e-9,
            "to_s": max(times) * 1e-9, "whole": whole,
        }
        for kind, times in sorted(kinds.items())
    ] or [{"problem": "nothing that is known"}]  # fmt: skip


def _in_words(value: Any) -> str:
    if not isinstance(value, dict):
        return str(value)
    if "problem" in value:
        return str(value["problem"])
    more = "" if value["whole"] else ", and more"
    span = f"{value['from_s']:.2f} to {value['to_s']:.2f} s"
    return f"{value['kind']}: {value['read']}{more}, at {span} after the beginning"
