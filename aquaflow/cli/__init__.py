"""The command line. Thin: every command reads its arguments and calls one function.

Heavy modules load inside the commands, so that ``aquaflow --help`` costs no torch.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from aquaflow import __version__
from aquaflow.base.errors.crash_report import one_sentence, print_anything, refuse_unreadable
from aquaflow.cli.calibrate import calibrate
from aquaflow.cli.change import change
from aquaflow.cli.console import (
    PRESETS,
    InSite,
    Json,
    checked_site,
    progress_bars,
    unit_in_words,
)
from aquaflow.cli.doctor import config, doctor_group, inspect
from aquaflow.cli.export import export_group
from aquaflow.cli.lab import lab_group
from aquaflow.cli.measure import measure_group
from aquaflow.cli.service import (
    exit_code,
    map_realtime,
    open_preview,
    print_finished,
    record,
    run_group,
    stay_open,
    view,
)
from aquaflow.cli.site import app as site_group

if TYPE_CHECKING:
    from aquaflow.dive.run import Finished

OLD_NAMES: dict[tuple[str, ...], tuple[str, ...]] = {
    **{(word,): ("lab", word) for word in ("ablate", "batch", "bench", "evaluate", "prior")},
    **{(word,): ("lab", word) for word in ("stress", "synth")},
    ("bench", "dives"): ("lab", "bench"),
    ("devices",): ("doctor", "devices"),
    ("dive",): ("run", "finish"),
    ("dive", "finish"): ("run", "finish"),
    ("report",): ("export", "report"),
    ("scale",): ("measure", "scale"),
    ("status",): ("run", "status"),
    ("video",): ("export", "video"),
}
"""What commands were called before they had groups; understood for one release."""


class _InOrder(TyperGroup):
    """Lists its commands in the order in which a dive meets them."""

    def list_commands(self, ctx: Any) -> list[str]:
        """The names, as the help shows them."""
        del ctx
        return sorted(self.commands, key=COMMANDS.index)


app = typer.Typer(
    cls=_InOrder,
    help="Onboard mapping for underwater robots: trajectory, Gaussian map, and the water itself.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Entry point: whatever a command raises becomes one sentence and an exit code."""
    with one_sentence():
        # What Python warns of is for the log of the dive, not for who flies it.
        logging.captureWarnings(True)
        print_anything((sys.stdout, sys.stderr))
        refuse_unreadable(sys.argv[1:])
        sys.argv[1:] = with_new_name(sys.argv[1:])
        app()


def with_new_name(arguments: list[str]) -> list[str]:
    """The arguments with the command's name of today; a sentence on stderr where it was another."""
    for length in (2, 1):
        old = tuple(arguments[:length])
        if len(old) == length and old in OLD_NAMES:
            new = OLD_NAMES[old]
            typer.echo(f"'aquaflow {' '.join(old)}' is now 'aquaflow {' '.join(new)}'", err=True)
            return [*new, *arguments[length:]]
    return arguments


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Options of the program itself, without a command."""
    if version:
        typer.echo(__version__)
        raise typer.Exit


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
    in_browser: Annotated[
        bool, typer.Option("--view", help="Show the dive in a browser as it grows; until Ctrl-C.")
    ] = False,
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
    from aquaflow.config.presets import load_configured
    from aquaflow.config.stage import COMMAND_LINE

    settings = load_configured(
        config,
        preset,
        {"seed": seed, "threads": threads, "source": source_settings, "mapping": mapping},
        COMMAND_LINE,
    )
    from aquaflow.base.errors.failures import Failures
    from aquaflow.geometry.camera import load_camera
    from aquaflow.sources import open_recording
    from aquaflow.sources.picture_check import blank_at_first
    from aquaflow.sources.telemetry_input import open_telemetry

    calibration = None if calib is None else load_camera(calib)
    if realtime:
        _refuse_of_replays(telemetry, topic, in_browser)
    if in_site is not None:
        checked_site(in_site, out)
    if realtime:
        print_finished(
            map_realtime(source, settings, calibration, out, overwrite, as_json, in_site), as_json
        )
        return
    fps, logs = settings.source.fps, telemetry or ()
    recording = open_recording(source, fps, topic)
    given = open_telemetry(source, logs, telemetry_offset, fps, topic)

    from aquaflow.dive.replay import (
        map_recording,  # loads torch: after what can be refused without it
    )
    from aquaflow.tracking.base import base_of

    with Failures().contain("looking at the first pictures"):
        for clause in blank_at_first(recording, settings.source):
            typer.echo(f"Note: before mapping: {clause}.", err=True)
    with contextlib.ExitStack() as around:
        preview = None
        if in_browser:
            preview = around.enter_context(open_preview(settings.mapping.enabled))
        with progress_bars(quiet=as_json) as progress:
            replayed = map_recording(
                recording, source.name, out, settings, calibration, overwrite, progress, profile,
                given, base=None if in_site is None else base_of(in_site), path=source,
                preview=preview,
            )  # fmt: skip
        _print_replayed(replayed, as_json)
        if preview is not None and not as_json:
            stay_open(preview, replayed.dive)
    raise typer.Exit(exit_code(replayed))


def _refuse_of_replays(telemetry: list[Path] | None, topic: str | None, in_browser: bool) -> None:
    """Refuse, with ``--realtime``, the options that only a replay has."""
    from aquaflow.base.errors import ArgumentError

    if telemetry:
        raise ArgumentError(
            "--telemetry needs the poses of the whole recording; leave out --realtime, or name the "
            "log in a replay.yaml"
        )
    if topic is not None:
        raise ArgumentError("--topic is for a replay; leave out --realtime")
    if in_browser:
        raise ArgumentError(
            "--view is for a replay; leave out --realtime, or set viewer.enabled in the config of "
            "`aquaflow run --source`"
        )


def _print_replayed(finished: Finished, as_json: bool) -> None:
    """Numbers and notes of a dive."""
    metrics = finished.metrics
    if as_json:
        typer.echo(json.dumps({"dive": str(finished.dive), **metrics}))
        return
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
    shown = [name for name in ("report.html", "map.ply") if (finished.dive / name).exists()]
    typer.echo(f"Look at {' and '.join(str(finished.dive / name) for name in shown)}.")


HELP: dict[str, dict[str, tuple[Callable[..., None] | typer.Typer, str]]] = {
    "Recordings and live dives": {
        "map": (map_command, "Turn a recording into a dive: trajectory, map, water, report."),
        "inspect": (inspect, "What would be read of a recording, and what is odd in it."),
        "run": (run_group(), "Map live on a vehicle; ask how the service is; finish a dive."),
        "record": (record, "Record cameras and telemetry, to map them later."),
    },
    "Finished dives": {
        "view": (view, "Show a dive or a site in a browser, and measure in it."),
        "export": (export_group(), "Write a dive for other programs, as a report, as a video."),
        "measure": (measure_group(), "Areas, relief, lengths with their sigma; set the scale."),
        "site": (site_group, "Bring several dives of one place into one frame and map."),
        "change": (change, "What was gained, lost, moved or bleached between two dives."),
    },
    "Setting up and judging": {
        "calibrate": (calibrate, "Calibrate a camera from pictures of a board."),
        "doctor": (doctor_group(), "What this machine has and lacks; the devices that it finds."),
        "config": (config, "Check a config; print every setting, and what it opens."),
        "lab": (lab_group(), "Synthetic dives, truth, benchmarks, stress, priors, batches."),
    },
}
"""The help: headings, and below each its commands, with one line on what they do."""
COMMANDS = [name for commands in HELP.values() for name in commands]
"""Names of the commands and groups, in the order of the help."""

for _heading, _commands in HELP.items():
    for _name, (_command, _line) in _commands.items():
        if isinstance(_command, typer.Typer):
            app.add_typer(_command, name=_name, rich_help_panel=_heading, help=_line)
        else:
            app.command(_name, rich_help_panel=_heading, short_help=_line)(_command)
