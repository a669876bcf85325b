"""What is here, and what would be used: ``doctor``, ``doctor devices``, ``config``, ``inspect``."""

from __future__ import annotations

import json
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow.base.errors import InputError, printable
from aquaflow.cli.console import GroupWithDefault, Json, table_console

if TYPE_CHECKING:
    from aquaflow.sources import RecordedCamera
    from aquaflow.sources.discovery import DiscoveryResult
    from aquaflow.sources.telemetry_input import TelemetryInput
    from aquaflow.types import Frame


def doctor_group() -> typer.Typer:
    """The group ``doctor`` with its commands."""
    group = typer.Typer(cls=GroupWithDefault)
    group.command("doctor")(doctor)
    group.command()(devices)
    return group


def doctor(
    config: Annotated[
        Path | None, typer.Option(help="Check this YAML, and only what a run with it would open.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Report what this machine has, what AquaFlow will use, and what is missing."""
    from aquaflow.doctor import examine, print_findings, to_json

    if config is None:
        findings = examine()
    else:
        from aquaflow.config.vehicle import load_any
        from aquaflow.doctor.opened import check_opened

        findings = check_opened(load_any(config))
    if as_json:
        typer.echo(json.dumps(to_json(findings)))
    else:
        print_findings(findings, table_console())


def devices(
    host: Annotated[
        list[str] | None,
        typer.Option(help="Ask this computer on the network; may be repeated. Else a BlueROV2's."),
    ] = None,
    local: Annotated[
        bool, typer.Option("--local", help="Look at what is plugged in only, not at the network.")
    ] = False,
    as_json: Json = False,
) -> None:
    """List cameras, links and streams that are there, with the lines for the config."""
    from aquaflow.sources.discovery import VEHICLE_HOSTS, discover

    found = discover(() if local else tuple(host or VEHICLE_HOSTS))
    if as_json:
        typer.echo(json.dumps(asdict(found)))
    else:
        _print_devices(found)


def config(
    file: Annotated[
        Path | None, typer.Argument(help="A config to check and complete, also a vehicle's.")
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Also the lab's switches, which no user decides.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Print the effective configuration as YAML: every setting and its value, and what it opens."""
    import yaml

    from aquaflow.config import Config
    from aquaflow.config.stage import without_the_lab
    from aquaflow.config.vehicle import load_any
    from aquaflow.doctor import to_json
    from aquaflow.doctor.opened import check_opened

    settings = Config() if file is None else load_any(file)
    values, findings = settings.model_dump(mode="json"), check_opened(settings)
    if not everything:
        values = without_the_lab(type(settings), values)
    if as_json:
        typer.echo(json.dumps({"config": values, "opens": to_json(findings)["findings"]}))
        return
    typer.echo(yaml.safe_dump(values, sort_keys=False), nl=False)
    for each in findings:
        advice = f" ({each.advice})" if each.advice else ""
        typer.echo(printable(f"# {each.name}: {each.used_for}: {each.found}{advice}"))


def _print_devices(found: DiscoveryResult) -> None:
    from rich.markup import escape
    from rich.table import Table

    console = table_console()
    if found.devices:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 1, 0))
        for heading in ("kind", "found", "what it gives", "for the config"):
            table.add_column(heading, overflow="fold")
        for device in found.devices:
            table.add_row(
                device.kind,
                escape(f"{device.name}\n{device.id}"),
                escape(device.detail),
                escape(_as_yaml(device.config)),
            )
        console.print(table)
    else:
        typer.echo("Nothing was found: no camera, serial port, CAN interface, stream or DVL.")
    for problem in found.problems:
        typer.echo(f"Not looked for: {problem}.")


def _as_yaml(config: dict[str, Any]) -> str:
    import yaml

    if not config:
        return ""
    return str(yaml.safe_dump(config, sort_keys=False)).rstrip()


# --------------------------------------------------------------------------------------------------
# The command that says what would be read of a recording: ``inspect``.

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
