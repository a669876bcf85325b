"""The command line. Thin: every command reads its arguments and calls one function.

Heavy modules load inside the commands, so that ``aquaflow --help`` costs no torch.
"""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow import __version__
from aquaflow.base.errors import printable
from aquaflow.base.errors.crash_report import one_sentence, print_anything, refuse_unreadable
from aquaflow.cli.batch import register as register_batch
from aquaflow.cli.bench import register as register_bench
from aquaflow.cli.calibrate import register as register_calibrate
from aquaflow.cli.change import register as register_change
from aquaflow.cli.console import (
    PRESETS,
    InSite,
    Json,
    checked_site,
    progress_bars,
    table_console,
    unit_in_words,
)
from aquaflow.cli.devices import register as register_devices
from aquaflow.cli.dive import register as register_dive
from aquaflow.cli.export import register as register_export
from aquaflow.cli.inspect import register as register_inspect
from aquaflow.cli.measure import register as register_measure
from aquaflow.cli.prior import register as register_prior
from aquaflow.cli.record import register as register_record
from aquaflow.cli.report import register as register_report
from aquaflow.cli.scale import register as register_scale
from aquaflow.cli.service import exit_code, map_realtime, print_finished
from aquaflow.cli.service import register as register_service
from aquaflow.cli.site import register as register_site
from aquaflow.cli.stress import register as register_stress
from aquaflow.cli.video import register as register_video

if TYPE_CHECKING:
    from aquaflow.dive.run import Finished

app = typer.Typer(
    help="Onboard mapping for underwater robots: trajectory, Gaussian map, and the water itself.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Entry point: whatever a command raises becomes one sentence and an exit code."""
    # What Python warns of is for the log of the dive, not for who flies it.
    logging.captureWarnings(True)
    print_anything((sys.stdout, sys.stderr))
    with one_sentence():
        refuse_unreadable(sys.argv[1:])
        app()


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Options of the program itself, without a command."""
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command("map")
def map_command(
    source: Annotated[Path, typer.Argument(help="Folder of images, video, or synthetic dive.")],
    out: Annotated[Path, typer.Option(help="Dive folder to write.")] = Path("out/dive"),
    calib: Annotated[Path | None, typer.Option(help="camera.yaml; else a guess, refined.")] = None,
    config: Annotated[Path | None, typer.Option(help="YAML config; see `aquaflow config`.")] = None,
    every: Annotated[int | None, typer.Option(help="Use every n-th frame.")] = None,
    start: Annotated[int | None, typer.Option(help="First frame.")] = None,
    stop: Annotated[int | None, typer.Option(help="First frame not used.")] = None,
    width: Annotated[int | None, typer.Option(help="Width in pixels to map at.")] = None,
    crop: Annotated[str | None, typer.Option(help="left | right | x,y,width,height")] = None,
    mask: Annotated[
        Path | None, typer.Option(help="Picture of the camera's size: white is used, black not.")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames/s of a folder.")] = None,
    topic: Annotated[str | None, typer.Option(help="Picture topic of a bag.")] = None,
    preset: Annotated[str | None, typer.Option(help=PRESETS)] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of every random draw.")] = None,
    threads: Annotated[int | None, typer.Option(help="Default: every core.")] = None,
    refine_steps: Annotated[int | None, typer.Option(help="Steps after the last frame.")] = None,
    refine_seconds: Annotated[
        float | None, typer.Option(help="Time limit of refining; runs then differ.")
    ] = None,
    tracking_only: Annotated[bool, typer.Option(help="Trajectory without a map.")] = False,
    telemetry: Annotated[
        list[Path] | None, typer.Option(help="Log recorded with it; may be given several times.")
    ] = None,
    telemetry_offset: Annotated[
        float | None,
        typer.Option(help="When the logs begin, s after the first picture; else it is found."),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace the dive in --out.")] = False,
    realtime: Annotated[
        bool, typer.Option(help="As the live loop would: newest frame only, mapping in parallel.")
    ] = False,
    profile: Annotated[bool, typer.Option(help="Write trace.json for Chrome's tracing.")] = False,
    in_site: InSite = None,
    as_json: Json = False,
) -> None:
    """Turn a recording into a dive folder: trajectory, map, water, report."""
    source_settings = {
        "every": every, "start": start, "stop": stop, "width": width, "crop": crop, "fps": fps,
        "mask": mask,
    }  # fmt: skip
    optimiser = {"refine_steps": refine_steps, "refine_seconds": refine_seconds}
    mapping = {"optimiser": optimiser, "enabled": False if tracking_only else None}
    from aquaflow.config.presets import configured

    settings = configured(
        config,
        preset,
        {"seed": seed, "threads": threads, "source": source_settings, "mapping": mapping},
        "command line",
    )
    from aquaflow.base.errors import InputError
    from aquaflow.geometry.camera import load_camera
    from aquaflow.sources import open_recording
    from aquaflow.sources.telemetry_input import open_telemetry

    calibration = None if calib is None else load_camera(calib)
    if realtime and telemetry:
        raise InputError(
            "--telemetry needs the poses of the whole recording; leave out --realtime, or name the "
            "log in a replay.yaml"
        )
    if realtime and topic is not None:
        raise InputError("--topic is for a replay; leave out --realtime")
    if in_site is not None:
        checked_site(in_site, out)
    if realtime:
        print_finished(
            map_realtime(source, settings, calibration, out, overwrite, as_json, in_site), as_json
        )
        return
    recording = open_recording(source, settings.source.fps, topic)
    given = open_telemetry(source, telemetry or (), telemetry_offset)

    from aquaflow.dive.replay import (
        map_recording,  # loads torch: after what can be refused without it
    )
    from aquaflow.tracking.base.opening import base_of

    with progress_bars(quiet=as_json) as progress:
        replayed = map_recording(
            recording, source.name, out, settings, calibration, overwrite, progress, profile,
            given, base=None if in_site is None else base_of(in_site),
        )  # fmt: skip
    if as_json:
        typer.echo(json.dumps({"dive": str(replayed.dive), **replayed.metrics}))
        raise typer.Exit(exit_code(replayed))
    _print_summary(replayed)
    shown = [name for name in ("report.html", "map.ply") if (replayed.dive / name).exists()]
    typer.echo(f"Look at {' and '.join(str(replayed.dive / name) for name in shown)}.")
    raise typer.Exit(exit_code(replayed))


@app.command()
def synth(
    out: Annotated[Path, typer.Argument(help="Folder to write.")],
    scene: Annotated[
        str, typer.Option(help="reef | flat_sand | wall | pipe | pool | survey | hull | net")
    ] = "reef",
    water: Annotated[str | None, typer.Option(help="Water type, such as coastal_1C.")] = None,
    frames: Annotated[int | None, typer.Option(help="Number of pictures.")] = None,
    width: Annotated[int | None, typer.Option(help="Pixels.")] = None,
    height: Annotated[int | None, typer.Option(help="Pixels.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of every random draw.")] = 0,
    display: Annotated[
        str | None, typer.Option(help="Burned in: clock | clock_and_crosshair | panel")
    ] = None,
    fish: Annotated[int, typer.Option(help="Fish that cross the view, each once.")] = 0,
    arm: Annotated[
        bool, typer.Option("--arm", help="The vehicle's arm is in the picture.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a synthetic dive with its ground truth."""
    from pydantic import ValidationError

    from aquaflow.base.errors import ConfigError
    from aquaflow.lab.synthetic import SyntheticConfig, write_dive

    asked = {
        "scene": scene, "water": water, "frames": frames, "width": width, "height": height,
        "seed": seed, "display": display, "fish": fish, "arm": arm,
    }  # fmt: skip
    try:
        config = SyntheticConfig.model_validate({k: v for k, v in asked.items() if v is not None})
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"--{first['loc'][0]}: {first['msg'].lower()}") from error
    with progress_bars(quiet=as_json) as progress:
        write_dive(out, config, lambda done, total: progress("render", done, total))
    if as_json:
        typer.echo(json.dumps({"out": str(out), "frames": config.frames}))
    else:
        typer.echo(f"Wrote {config.frames} pictures with their truth to {out}.")


@app.command()
def evaluate(
    dive: Annotated[Path, typer.Argument(help="Dive folder.")],
    truth: Annotated[
        Path | None, typer.Option(help="poses.tum, a synthetic dive, or a table of positions.")
    ] = None,
    clean: Annotated[
        Path | None, typer.Option(help="The same recording without water, for restored views.")
    ] = None,
    clean_crop: Annotated[str | None, typer.Option(help="Crop of --clean, such as right.")] = None,
    recording: Annotated[
        Path | None, typer.Option(help="What was mapped: do its pictures agree with the poses?")
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure a dive: colours of restored views, and what the truth allows to compare."""
    from aquaflow.base.errors import InputError
    from aquaflow.base.storage.dive_status import refuse_unfinished
    from aquaflow.lab.evaluation.epipolar_error import evaluate_epipolar
    from aquaflow.lab.evaluation.naturalness import evaluate_naturalness
    from aquaflow.lab.evaluation.protocol import evaluate_dive
    from aquaflow.lab.evaluation.restoration import evaluate_restoration
    from aquaflow.lab.evaluation.summary import in_words

    refuse_unfinished(dive)
    natural = evaluate_naturalness(dive)
    if truth is None and clean is None and recording is None and natural is None:
        raise InputError(
            f"{dive} has no restored held-out views to look at; give --truth, --clean or "
            "--recording"
        )
    result: dict[str, Any] = {"naturalness": natural and natural.to_json()}
    if truth is not None:
        result |= evaluate_dive(dive, truth).to_json()
    if clean is not None:
        result["restoration"] = evaluate_restoration(dive, clean, clean_crop).to_json()
    if recording is not None:
        result["epipolar"] = evaluate_epipolar(dive, recording, truth).to_json()
    if as_json:
        typer.echo(json.dumps(result))
    else:
        typer.echo("\n".join(in_words(result)))


@app.command()
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
        from aquaflow.doctor.opened import opened

        findings = opened(load_any(config))
    if as_json:
        typer.echo(json.dumps(to_json(findings)))
    else:
        print_findings(findings, table_console())


@app.command("config")
def config_command(
    file: Annotated[
        Path | None, typer.Argument(help="A config to check and complete, also a vehicle's.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Print the effective configuration as YAML: every key and its value, and what it opens."""
    import yaml

    from aquaflow.config import Config
    from aquaflow.config.vehicle import load_any
    from aquaflow.doctor import to_json
    from aquaflow.doctor.opened import opened

    settings = Config() if file is None else load_any(file)
    values, findings = settings.model_dump(mode="json"), opened(settings)
    if as_json:
        typer.echo(json.dumps({"config": values, "opens": to_json(findings)["findings"]}))
        return
    typer.echo(yaml.safe_dump(values, sort_keys=False), nl=False)
    for each in findings:
        advice = f" ({each.advice})" if each.advice else ""
        typer.echo(printable(f"# {each.name}: {each.used_for}: {each.found}{advice}"))


def _print_summary(finished: Finished) -> None:
    metrics = finished.metrics
    for warning in finished.warnings:
        typer.echo(f"Warning: {warning}.")
    quality = (
        "no held-out frames"
        if metrics["psnr"] is None
        else f"held-out PSNR {metrics['psnr']:.2f} dB ({metrics['psnr_as_tracked']:.2f} as "
        f"tracked), SSIM {metrics['ssim']:.3f}"
    )
    typer.echo(
        f"{metrics['tracked']} of {metrics['frames']} frames posed, {metrics['keyframes']} "
        f"keyframes, {metrics['gaussians']} Gaussians, {quality}, {metrics['wall_s']:.0f} s."
    )
    for line in unit_in_words(metrics):
        typer.echo(line)
    for note in finished.notes:
        typer.echo(f"Note: {note}.")


register_batch(app)
register_bench(app)
register_calibrate(app)
register_change(app)
register_devices(app)
register_dive(app)
register_export(app)
register_inspect(app)
register_prior(app)
register_record(app)
register_report(app)
register_scale(app)
register_measure(app)
register_service(app)
register_site(app)
register_stress(app)
register_video(app)
