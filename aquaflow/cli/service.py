"""Live on a vehicle: ``run``, ``run status``, ``run finish``, ``record``; and ``view``."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

import typer

from aquaflow.base.worker import stop_on_signals
from aquaflow.cli.console import (
    PRESETS,
    GroupWithDefault,
    InSite,
    Json,
    Seconds,
    WhiteBalanceOption,
    checked_site,
    live_on_stderr,
    progress_bars,
    table_console,
    unit_in_words,
)

if TYPE_CHECKING:
    from aquaflow.config import Config
    from aquaflow.config.vehicle import VehicleConfig
    from aquaflow.dive.preview import Preview
    from aquaflow.dive.run import Finished
    from aquaflow.geometry.camera import CameraModel
    from aquaflow.live.feed import Feed
    from aquaflow.live.recorder.session import RecordingSession
    from aquaflow.live.recorder.status import RecorderStatus

NOTHING_TO_MAP = "nothing to map: give --config with cameras, or --source"
NOTHING_TO_RECORD = "nothing to record: give --config with cameras or telemetry, or --source"

POOR_RESULT = 3
"""Exit code of a dive that was written but has warnings: hardly any poses, an empty map, a
calibration that does not fit, or a defect of ours."""

MOST_SPLATS = 500_000
"""Gaussians of a finished dive that a browser gets: 7.6 MB, 6 s at 10 Mbit/s, of which the first
0.3 MB are a picture (docs/viewer.md)."""


def run_group() -> typer.Typer:
    """The group ``run`` with its commands."""
    group = typer.Typer(cls=GroupWithDefault)
    group.command("run")(run)
    group.command()(status)
    group.command()(finish)
    return group


def run(
    config: Annotated[
        Path | None, typer.Option(help="The vehicle's YAML: cameras, telemetry, service.")
    ] = None,
    source: Annotated[
        Path | None, typer.Option(help="Map this recording as if it happened now.")
    ] = None,
    calib: Annotated[
        Path | None, typer.Option(help="Of --source: camera.yaml; else a guess, refined.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Dive folder; else one in service.dives, named by time.")
    ] = None,
    preset: Annotated[str | None, typer.Option(help=f"On top of --config: {PRESETS}")] = None,
    new: Annotated[bool, typer.Option("--new", help="Begin a new dive; resume nothing.")] = False,
    speed: Annotated[
        float,
        typer.Option(min=0.001, max=1000.0, help="Of --source: 1 as it was, 2 twice as fast."),
    ] = 1.0,
    seconds: Seconds = None,
    in_site: InSite = None,
    as_json: Json = False,
) -> None:
    """Map live: cameras and telemetry in, dive folder out; resumes what was interrupted."""
    from aquaflow.base.errors import ArgumentError, InputError
    from aquaflow.config.vehicle import load_vehicle, looking_in
    from aquaflow.geometry.camera import load_camera
    from aquaflow.live.onboard import devices, recording

    if source is None and config is None:
        raise ArgumentError(NOTHING_TO_MAP)
    vehicle = load_vehicle(config, preset)
    if in_site is not None:
        vehicle = looking_in(vehicle, checked_site(in_site, out))
    if source is None and not vehicle.cameras:
        raise InputError(NOTHING_TO_MAP)
    if source is None and calib is not None:
        raise ArgumentError(
            f"--calib {calib} is for --source; a camera's calibration stands in --config, under "
            "cameras"
        )

    from aquaflow.live.onboard import map_live  # loads torch

    live_on_stderr()
    if source is None:
        feed: Feed = devices(vehicle)
    else:
        calibration = None if calib is None else load_camera(calib)
        feed = recording(source, vehicle, speed, calibration)
    with progress_bars(quiet=as_json) as progress:
        finished = map_live(
            feed, vehicle, out, new, seconds, lambda done, total: progress("refine", done, total)
        )
    print_finished(finished, as_json)


def status(
    url: Annotated[str, typer.Option(help="Where the service answers.")] = "http://127.0.0.1:8230",
    token_file: Annotated[Path | None, typer.Option(help="File that holds the token.")] = None,
    as_json: Json = False,
) -> None:
    """Ask the running service how it is; exit code 0 only if nothing is to be done about it."""
    from aquaflow.live.health.http import ask
    from aquaflow.web.access import read_token

    report = ask(url, None if token_file is None else read_token(token_file))
    if as_json:
        typer.echo(json.dumps(report))
    else:
        _print_status(report)
    raise typer.Exit(0 if report.get("ok") else 1)


def finish(
    folder: Annotated[Path, typer.Argument(help="Dive folder.", metavar="DIVE")],
    seconds: Annotated[
        float | None,
        typer.Option(min=0.0, help="Of refining; by default as in the dive's config.yaml."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Finish a live dive whose process was killed: refine, evaluate, write every file."""
    from aquaflow.live.finish import FinishedAlreadyError, finish_dive  # loads torch

    live_on_stderr()
    try:
        with progress_bars(quiet=as_json) as progress:
            finished = finish_dive(
                folder, seconds, lambda done, total: progress("refine", done, total)
            )
    except FinishedAlreadyError as said:
        typer.echo(json.dumps({"dive": str(folder)}) if as_json else f"{said}.")
        return
    print_finished(finished, as_json)


def view(
    dive: Annotated[Path, typer.Argument(help="Dive folder, or a merged site.")],
    component: Annotated[
        int | None, typer.Option(help="Of a site, by default the one with most keyframes.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="0: any that is free.")] = 8231,
    token_file: Annotated[
        Path | None, typer.Option(help="File that holds the token; needed beyond this machine.")
    ] = None,
    splats: Annotated[int, typer.Option(help="Gaussians to show at most.")] = MOST_SPLATS,
    white_balance: WhiteBalanceOption = None,
) -> None:
    """Show a finished dive or a site in a browser, to look around and to measure; until Ctrl-C."""
    from aquaflow.base.errors import InputError
    from aquaflow.config.service import ViewerConfig
    from aquaflow.config.stage import COMMAND_LINE, validate
    from aquaflow.survey.site.manifest import is_site
    from aquaflow.survey.viewer.finished import note_unfinished, open_dive
    from aquaflow.survey.viewer.site_page import open_site

    asked = {"enabled": True, "host": host, "port": port, "token_file": token_file}
    config = validate(ViewerConfig, asked | {"splats": splats}, COMMAND_LINE)
    if is_site(dive):
        if white_balance is not None:
            raise InputError(
                f"{dive} is a site, whose dives have one each; leave --white-balance out"
            )
        window = open_site(dive, config, component)
    elif component is None:
        mark, turn = partial(_mark, dive), partial(_turn, dive)
        window = open_dive(dive, config, mark, white_balance, turn)
        if said := note_unfinished(dive):
            typer.echo(f"Warning: {said}.", err=True)
    else:
        raise InputError(f"{dive} is no site: only a site has components; leave --component out")
    _wait(window.address)
    window.close()


def _wait(address: str) -> None:
    typer.echo(f"Open {address} in a browser; Ctrl-C ends it.")
    with contextlib.suppress(KeyboardInterrupt):
        threading.Event().wait()


def open_preview(mapping: bool) -> Preview:
    """The page of ``map --view``, and where it is; ``mapping``: it will have a map."""
    from aquaflow.dive.preview import Preview

    preview = Preview()
    shown = "the map" if mapping else "the path, as without a map there is none,"
    typer.echo(f"Open {preview.address} in a browser to see {shown} grow.", err=True)
    return preview


def stay_open(preview: Preview, dive: Path) -> None:
    """The finished dive in place of its preview, or that as it is where there is no map; until
    Ctrl-C."""
    preview.finish(dive)
    if not (dive / "map.ply").exists():
        _wait(preview.address)
        return
    preview.close()
    with contextlib.suppress(KeyboardInterrupt):
        view(dive, port=urlsplit(preview.address).port or 0)


def _mark(
    dive: Path,
    ends: tuple[tuple[float, float, float], tuple[float, float, float]],
    length_m: float,
    sigma_m: float,
) -> tuple[str, bool]:
    """Keep a length that was marked in the viewer; what came of it, and whether files changed."""
    from aquaflow.dive.dive import Dive
    from aquaflow.survey.measure.scale_bar import (
        between_points,  # loads torch
        keep_length,
    )

    marked = keep_length(dive, between_points(Dive(dive), *ends, length_m, sigma_m))
    return f"{marked.in_words()}\n{marked.unchanged or ''}".rstrip(), marked.unchanged is None


def _turn(dive: Path, places: list[tuple[float, float, float]]) -> str:
    """Turn the dive level by points that were marked in the viewer; what came of it."""
    from aquaflow.survey.measure.asked import MapPoint
    from aquaflow.survey.measure.levelling import make_level, of_points  # loads torch

    found = make_level(dive, lambda read: of_points(read, [MapPoint(*at) for at in places]))
    return found.in_words()


def _print_status(report: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    console = table_console()
    colour = "green" if report.get("ok") else "red"
    console.print(f"[bold {colour}]{escape(report['state'])}[/]: {escape(report['reason'])}")
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for key, value in report.items():
        if key not in ("state", "reason", "ok", "changes"):
            table.add_row(key.replace("_", " "), escape(_in_words(value)))
    console.print(table)
    for change in report.get("changes", []):
        words = f"{change['before']} -> {change['after']}: {change['reason']}"
        console.print(f"{change['ago_s']:>8.0f} s ago  {escape(words)}")


def _in_words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_in_words(each)}" for key, each in value.items()) or "none"
    return "-" if value is None else str(value)


def exit_code(finished: Finished) -> int:
    """0 for a dive as it was asked for, ``POOR_RESULT`` for one with warnings."""
    return POOR_RESULT if finished.warnings else 0


def map_realtime(
    source: Path,
    settings: Config,
    calibration: CameraModel | None,
    out: Path,
    overwrite: bool,
    quiet: bool,
    in_site: Path | None = None,
) -> Finished | None:
    """``map --realtime``: a recording through the live loop, refined as a replay is."""
    from aquaflow.config.vehicle import VehicleConfig
    from aquaflow.live.onboard import map_live, recording

    alone = VehicleConfig().service.model_dump()
    alone["dive"]["site"] = in_site
    alone["health"]["enabled"], alone["mapping"]["refine_seconds"] = False, None
    vehicle = VehicleConfig.model_validate(settings.model_dump() | {"service": alone})
    feed = recording(source, vehicle, calibration=calibration)
    live_on_stderr()
    with progress_bars(quiet=quiet) as progress:
        return map_live(
            feed, vehicle, out, progress=lambda done, total: progress("refine", done, total),
            overwrite=overwrite,
        )  # fmt: skip


def print_finished(finished: Finished | None, as_json: bool) -> None:
    """Print the summary of a live dive, and end the command with its exit code."""
    if finished is None:
        typer.echo("{}" if as_json else "Nothing was mapped; frames.csv says why.")
        raise typer.Exit(POOR_RESULT)
    numbers = finished.metrics
    if as_json:
        typer.echo(json.dumps({"dive": str(finished.dive), **numbers}))
        raise typer.Exit(exit_code(finished))
    for warning in finished.warnings:
        typer.echo(f"Warning: {warning}.")
    typer.echo(
        f"{numbers['tracked']} of {numbers['frames']} frames posed, {numbers['keyframes']} "
        f"keyframes, {numbers['gaussians']} Gaussians in {finished.dive}."
    )
    for line in unit_in_words(numbers):
        typer.echo(line)
    for note in finished.notes:
        typer.echo(f"Note: {note}.")
    raise typer.Exit(exit_code(finished))


# --------------------------------------------------------------------------------------------------
# record

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
    from aquaflow.base.errors import ArgumentError, InputError
    from aquaflow.config.vehicle import VehicleConfig, load_vehicle
    from aquaflow.live.recorder.recorder import Recorder
    from aquaflow.live.recorder.session import RecordingSession

    if source is None and config is None:
        raise ArgumentError(NOTHING_TO_RECORD)
    vehicle = VehicleConfig() if config is None else load_vehicle(config)
    if picture is not None:
        vehicle = _with_picture(vehicle, picture)
    if source is None and not (vehicle.cameras or vehicle.telemetry.devices):
        raise InputError(NOTHING_TO_RECORD)
    folder = out or Path("out") / time.strftime("recording-%Y%m%d-%H%M%S")
    add_sources = _devices(vehicle) if source is None else _recording(source)
    session = RecordingSession(Recorder(folder, vehicle.recording))
    try:
        add_sources(session)
        with stop_on_signals(session.stopping), progress_bars(quiet=as_json) as progress:
            session.run(seconds, progress)
    finally:
        status = session.recorder.close()
    _print_recording(session, status, folder, as_json)
    if status.stopped is not None:
        raise InputError(f"recording stopped: {status.stopped}")


def _with_picture(vehicle: VehicleConfig, picture: str) -> VehicleConfig:
    from aquaflow.config.service import RecordingConfig
    from aquaflow.config.stage import COMMAND_LINE, validate

    asked = vehicle.recording.model_dump() | {"picture": picture}
    recording = validate(RecordingConfig, asked, COMMAND_LINE)
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


def _print_recording(
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
