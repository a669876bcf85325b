"""The commands that measure AquaFlow itself: ``lab bench`` and ``lab ablate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, get_args

import typer

from aquaflow.base.errors import ArgumentError
from aquaflow.cli.console import (
    PRESETS,
    GroupWithDefault,
    Json,
    one_of,
    progress_bars,
    table_console,
)

Suite = Annotated[str | None, typer.Option(help="ci (synthetic) | real DATA_DIR")]
Data = Annotated[Path | None, typer.Argument(help="Of --suite real: a folder for each clip.")]
Scenes = Annotated[list[Path] | None, typer.Option("--scene", help="Recording; may be repeated.")]

Device = Annotated[
    str | None, typer.Option(help="cpu | cuda: what is drawn there alone; default: wherever.")
]


def bench_group() -> typer.Typer:
    """The group ``lab bench`` with its commands."""
    group = typer.Typer(
        cls=GroupWithDefault, help="Run time against error; also of the renderer and of long dives."
    )
    group.command("bench")(bench)
    group.command()(render)
    group.command()(growth)
    return group


def bench(
    data: Data = None,
    suite: Suite = None,
    scene: Scenes = None,
    preset: Annotated[
        list[str] | None, typer.Option(help="May be repeated; default: the three for a CPU.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each, interleaved.")] = 1,
    peers: Annotated[bool, typer.Option(help="Run COLMAP and two-view odometry too.")] = True,
    device: Device = None,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("out/bench"),
    readme: Annotated[
        Path | None, typer.Option(help="Write table and picture into this Markdown file.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Run time against error: scenes x presets as a table, a picture and bench.json."""
    from aquaflow.config.presets import BY_EFFORT, FOR_A_GPU
    from aquaflow.lab.bench import benchmark as bm
    from aquaflow.lab.bench.table import around_section

    if data is not None and suite is None and not scene:
        raise ArgumentError(
            f"bench knows neither a command nor a suite '{data}'; "
            "give render, --suite real DATA_DIR, or --scene PATH"
        )

    if readme is not None:
        around_section(readme)
    if device is not None:
        from aquaflow.lab.bench.meter import DEVICES, require

        require(one_of(DEVICES, device, "--device"))
    presets = (*BY_EFFORT, *FOR_A_GPU) if device == "cuda" else BY_EFFORT
    contenders = bm.contenders_of(preset or presets, peers)
    with progress_bars(as_json) as progress:
        scenes = bm.scenes_of(suite, data, scene or [], out, progress)
        result = bm.benchmark(scenes, contenders, repeats, out, progress, device=device)
    if readme is not None:
        from aquaflow.lab.bench.table import write_readme

        write_readme(readme, out / bm.PICTURE_FILE, result["machine"], result["runs"])
    if as_json:
        typer.echo(json.dumps(result))
        return
    from aquaflow.lab.bench.table import print_table

    print_table(result["runs"], table_console())
    if result["machine"]["gpu"]:
        typer.echo(f"GPU: {result['machine']['gpu']}.")
    typer.echo(f"Look at {out / bm.PICTURE_FILE}; all numbers are in {out / bm.JSON_FILE}.")


def render(
    quick: Annotated[bool, typer.Option("--quick", help="Only the bars' two sizes.")] = False,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each, interleaved.")] = 7,
    device: Device = None,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("out/bench_render"),
    as_json: Json = False,
) -> None:
    """Forward and backward ms of every renderer here: table, picture, render_bench.json."""
    from aquaflow.lab.bench.meter import DEVICES
    from aquaflow.lab.bench.render import benchmark as bm
    from aquaflow.lab.bench.render.table import QUICK_SIZES, SIZES

    device = None if device is None else one_of(DEVICES, device, "--device")
    sizes = QUICK_SIZES if quick else SIZES
    with progress_bars(as_json) as progress:
        result = bm.bench_render(sizes, repeats, out, progress, device)
    if as_json:
        typer.echo(json.dumps(result))
        return
    from aquaflow.lab.bench.render.table import print_result

    print_result(result, table_console())
    typer.echo(f"Look at {out / bm.PICTURE_FILE}; all numbers are in {out / bm.JSON_FILE}.")


def growth(
    frames: Annotated[
        list[int] | None, typer.Option(help="May be repeated; default: 1000, 5000, 20000.")
    ] = None,
    width: Annotated[int, typer.Option(min=64, max=1920, help="Of the pictures, pixels.")] = 160,
    preset: Annotated[str, typer.Option(help=PRESETS)] = "balanced",
    tracking_only: Annotated[bool, typer.Option(help="Trajectories without maps.")] = False,
    scene: Annotated[
        str, typer.Option(help="lines | hour: with transits, revisits and all that befalls a dive.")
    ] = "lines",
    telemetry: Annotated[str, typer.Option(help="none | attitude | dvl: what is aboard.")] = "none",
    config: Annotated[Path | None, typer.Option(help="Settings below the preset's.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Only 150 and 300 frames.")] = False,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("out/bench_growth"),
    as_json: Json = False,
) -> None:
    """What a frame costs in long dives: synthetic surveys, CPU time, memory, files, viewer."""
    from aquaflow.lab.bench.growth import benchmark as bm
    from aquaflow.lab.bench.growth.job import Instruments
    from aquaflow.lab.synthetic.survey_plan import SurveyScene

    counts = frames or (bm.QUICK_FRAMES if quick else bm.FRAMES)
    shown = one_of(get_args(SurveyScene), scene, "--scene")
    aboard = one_of(get_args(Instruments), telemetry, "--telemetry")
    jobs = bm.jobs_of(counts, width, preset, tracking_only, out, shown, aboard, config)
    with progress_bars(as_json) as progress:
        result = bm.bench_growth(jobs, out, progress)
    if as_json:
        typer.echo(json.dumps(result))
        return
    typer.echo((out / bm.TABLE_FILE).read_text())
    typer.echo(f"Look at {out / bm.PICTURE_FILE}; all numbers are in {out / bm.JSON_FILE}.")


def ablate(
    data: Data = None,
    suite: Suite = None,
    scene: Scenes = None,
    part: Annotated[
        list[str] | None, typer.Option(help="Word in a row's name; may be repeated. All rows.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("out/ablation"),
    as_json: Json = False,
) -> None:
    """What each part is worth: everything once without it, error and time against full."""
    from aquaflow.lab.bench import ablation
    from aquaflow.lab.bench.benchmark import scenes_of

    parts = ablation.parts_called(part or [])
    with progress_bars(as_json) as progress:
        scenes = scenes_of(suite, data, scene or [], out, progress)
        if suite == "ci":
            scenes = [s for s in scenes if s.name in ablation.CI_SCENES] or scenes
        result = ablation.ablate(scenes, out, progress, parts)
    (out / "ablate.json").write_text(json.dumps(result, indent=2) + "\n")
    if as_json:
        typer.echo(json.dumps(result))
    else:
        ablation.print_ablation(result["rows"], table_console())
