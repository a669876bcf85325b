"""The command that records: ``record``. Thin, like all of cli/."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aquaflow.base.worker import stop_on_signals
from aquaflow.cli.console import Json, Seconds, progress_bars

if TYPE_CHECKING:
    from aquaflow.config.vehicle import VehicleConfig
    from aquaflow.live.recorder.session import RecordingSession
    from aquaflow.live.recorder.status import RecorderStatus

SOURCE_CAMERA = "camera"
"""Name of the camera of a recording that is recorded again."""


def record(
    config: Annotated[
        Path | None, typer.Option(help="The vehicle's YAML: cameras, telemetry, recording.")
    ] = None,
    source: Annotated[
        Path | None, typer.Option(help="Record this recording as if it happened now.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; else named by time.")] = None,
    seconds: Seconds = None,
    picture: Annotated[str | None, typer.Option(help="jpeg | png | raw")] = None,
    as_json: Json = False,
) -> None:
    """Record cameras and telemetry to MCAP files; Ctrl-C ends it cleanly."""
    from aquaflow.base.errors import InputError
    from aquaflow.config.vehicle import VehicleConfig, load_vehicle
    from aquaflow.live.recorder.recorder import Recorder
    from aquaflow.live.recorder.session import RecordingSession

    vehicle = VehicleConfig() if config is None else load_vehicle(config)
    if picture is not None:
        vehicle = _with_picture(vehicle, picture)
    if source is None and not (vehicle.cameras or vehicle.telemetry.devices):
        raise InputError("nothing to record: give --config with cameras or telemetry, or --source")
    folder = out or Path("out") / time.strftime("recording-%Y%m%d-%H%M%S")
    add_sources = _devices(vehicle) if source is None else _recording(source)
    session = RecordingSession(Recorder(folder, vehicle.recording))
    try:
        add_sources(session)
        with stop_on_signals(session.stopping), progress_bars(quiet=as_json) as progress:
            session.run(seconds, progress)
    finally:
        status = session.recorder.close()
    _print_status(session, status, folder, as_json)
    if status.stopped is not None:
        raise InputError(f"recording stopped: {status.stopped}")


def _with_picture(vehicle: VehicleConfig, picture: str) -> VehicleConfig:
    from aquaflow.config.service import RecordingConfig
    from aquaflow.config.stage import validate

    asked = vehicle.recording.model_dump() | {"picture": picture}
    recording = validate(RecordingConfig, asked, "--picture")
    return vehicle.model_copy(update={"recording": recording})


def _devices(vehicle: VehicleConfig) -> Callable[[RecordingSession], None]:
    """Open the cameras; links are opened with the recorder, which gets their first byte."""
    from aquaflow.live.feed import record_mountings
    from aquaflow.sources import open_camera, open_links

    cameras = {name: open_camera(name, config) for name, config in vehicle.cameras.items()}
    for camera in cameras.values():
        camera.connect()

    def add(session: RecordingSession) -> None:
        record_mountings(session.recorder, vehicle, cameras)
        tap, telemetry = session.recorder.raw, vehicle.telemetry
        session.add_live(cameras, [open_links(telemetry, tap)] if telemetry.devices else [])

    return add


def _recording(path: Path) -> Callable[[RecordingSession], None]:
    """Open what lies at ``path``, camera and telemetry."""
    from aquaflow.recordings.playback import Playback
    from aquaflow.sources import camera_reader, open_recording, telemetry_reader

    reader = telemetry_reader(path)
    telemetry = [] if reader is None else [reader.open(path)]
    camera = open_recording(path) if camera_reader(path) or not telemetry else None
    playback = Playback(camera, telemetry, speed=1.0)
    return lambda session: session.add_playback(SOURCE_CAMERA, playback, telemetry)


def _print_status(
    session: RecordingSession, status: RecorderStatus, folder: Path, as_json: bool
) -> None:
    if as_json:
        typer.echo(
            json.dumps({"out": str(folder), **status.to_json(), "notes": list(session.notes)})
        )
        return
    typer.echo(
        f"Recorded {status.frames} pictures, {status.samples} samples and {status.link_bytes} "
        f"bytes of links: {status.written_bytes / 1e6:.1f} MB in {len(status.files)} files in "
        f"{folder}."
    )
    for topic, count in sorted(status.dropped.items()):
        typer.echo(f"Note: {count} messages of {topic} were dropped; the disk is too slow.")
    for note in session.notes:
        typer.echo(f"Note: {note}.")
