"""The commands that train, describe and check two-view priors. Thin, as all of cli/."""

from __future__ import annotations

import json
from dataclasses import replace
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow.base.errors import AquaFlowError, ArgumentError, InputError
from aquaflow.base.worker import usable_threads
from aquaflow.cli.console import Json, one_of, progress_bars, table_console

if TYPE_CHECKING:
    from aquaflow.prior.folder import PriorCard


class Exported(str, Enum):
    """Networks that can be exported."""

    mast3r = "mast3r"


def prior_group() -> typer.Typer:
    """The group ``lab prior`` with its commands."""
    prior = typer.Typer(
        help="The two-view prior: export, verify, bench, compare, train.", no_args_is_help=True
    )
    prior.command()(export)
    prior.command()(describe)
    prior.command()(verify)
    prior.command()(bench)
    prior.command()(oracle)
    prior.command()(compare)
    train = typer.Typer(help="Train a network.", no_args_is_help=True)
    train.command("mast3r")(train_mast3r)
    train.command("compact")(train_compact)
    prior.add_typer(train, name="train")
    return prior


def export(
    network: Annotated[Exported, typer.Argument(help="Which network.")],
    checkpoint: Annotated[Path, typer.Option(help="The public .pth file, which you bring.")],
    out: Annotated[Path, typer.Option(help="New folder to write.")] = Path("out/prior"),
    width: Annotated[int, typer.Option(help="px of the pictures, a multiple of 16.")] = 512,
    height: Annotated[int, typer.Option(help="px, a multiple of 16.")] = 384,
    as_json: Json = False,
) -> None:
    """Write encoder.onnx, decoder.onnx and prior.json for pictures of one size."""
    from aquaflow.lab.networks.mast3r.export import LICENCE_NOTICE, load_checkpoint
    from aquaflow.lab.networks.mast3r.export import export as export_mast3r

    del network  # there is one so far
    typer.echo(LICENCE_NOTICE, err=True)
    with progress_bars(as_json) as advance:
        model = load_checkpoint(checkpoint)
        card = export_mast3r(model, out, width, height, LICENCE_NOTICE, advance)
    print_parity(card.name, card.parity, {}, as_json)
    if not as_json:
        typer.echo(f"written to {out}")


def oracle(
    recording: Annotated[Path, typer.Argument(help="Synthetic dive, or what --dive was made of.")],
    out: Annotated[Path, typer.Option(help="New folder to write, for prior.folder.")],
    dive: Annotated[Path | None, typer.Option(help="Mapped dive whose map gives ranges.")] = None,
    range_sigma: Annotated[
        float, typer.Option(min=0.0, max=2.0, help="Relative error of its ranges.")
    ] = 0.05,
    dense: Annotated[
        bool, typer.Option("--dense", help="With points and descriptors of every pixel.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a prior that knows one dive, to find out what a good prior is worth."""
    from aquaflow.lab.evaluation.oracle_views import make_oracle

    with progress_bars(as_json) as advance:
        count = make_oracle(recording, out, range_sigma, advance, dive, dense)
    typer.echo(json.dumps({"pictures": count}) if as_json else f"{count} pictures, {out}")


def bench(
    folder: Annotated[
        list[Path] | None, typer.Option(help="Exported prior to time too; may be repeated.")
    ] = None,
    threads: Annotated[list[int] | None, typer.Option(min=1, help="May be repeated.")] = None,
    device: Annotated[str, typer.Option(help="auto | cpu | cuda | tensorrt")] = "auto",
    pictures: Annotated[
        Path | None, typer.Option(help="Folder of pictures to match; default: a generated one.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Frames of each kind.")] = 15,
    as_json: Json = False,
) -> None:
    """Milliseconds a frame, matching included, and matches found, of every prior that is here."""
    from aquaflow.lab.prior_bench.benchmark import bench_prior
    from aquaflow.lab.prior_bench.table import print_result

    with progress_bars(as_json) as advance:
        counts = list(dict.fromkeys(map(usable_threads, threads or [1])))
        result = bench_prior(folder or [], counts, device, pictures, repeats, advance)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        print_result(result, table_console())


def compare(
    pictures: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of pictures to warp and match; may be repeated."),
    ] = None,
    clip: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of a clip with poses_sfm.tum and camera.yaml; may be repeated."),
    ] = None,
    pairs: Annotated[int, typer.Option(min=1, help="Of each kind.")] = 16,
    pool: Annotated[
        Path | None, typer.Option(help="Keep generated scenes in this folder, for the next time.")
    ] = None,
    device: Annotated[str, typer.Option(help="auto | cpu | cuda")] = "cpu",
    as_json: Json = False,
) -> None:
    """Priors and keypoint networks of others on the same pairs: how right, and at what cost."""
    import torch

    from aquaflow.lab.prior_bench.benchmark import pictures_in
    from aquaflow.lab.prior_bench.comparison import compare as compared
    from aquaflow.lab.prior_bench.comparison import methods_here, pairs_of
    from aquaflow.lab.prior_bench.table import print_comparison

    torch.set_num_threads(1)
    seen = [picture for folder in pictures or [] for picture in pictures_in(folder)]
    with progress_bars(as_json) as advance:
        known = pairs_of(seen, clip or [], pairs, pool)
        result = compared(methods_here(device), known, advance)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        print_comparison(result, table_console())


def train_mast3r(
    checkpoint: Annotated[Path, typer.Option(help="Weights to start from, which you bring.")],
    data: Annotated[
        list[str],
        typer.Option(
            help="KIND=FOLDER, KIND tartanair, mimir, uwstereo, flsea or colmap; may be repeated."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of pairs, checkpoint, curve and weights.")],
    width: Annotated[int, typer.Option(help="px of the pictures, a multiple of 16.")] = 512,
    height: Annotated[int, typer.Option(help="px, a multiple of 16.")] = 384,
    epochs: Annotated[int, typer.Option(min=1, help="The first 2 of 15 are warm-up.")] = 30,
    batch: Annotated[int, typer.Option(min=1, help="Pairs at once, on each GPU.")] = 2,
    effective_batch: Annotated[
        int, typer.Option(min=1, help="Pairs of a step, on all GPUs together.")
    ] = 128,
    seed: Annotated[int, typer.Option(help="Of order and draws.")] = 0,
) -> None:
    """Fine-tune as in the paper; resumes from --out.

    Several GPUs: torchrun --nproc-per-node 4 --no-python aquaflow lab prior train mast3r ...
    """
    from aquaflow.lab.networks.mast3r.export import LICENCE_NOTICE, load_checkpoint
    from aquaflow.lab.training import finetune
    from aquaflow.lab.training.trainer import joined_processes

    settings = finetune.FineTuningSettings(
        width, height, epochs, max(1, epochs * 2 // 15), batch, effective_batch, seed
    )
    sequences = finetune.read_data(data)
    with joined_processes() as process, progress_bars(quiet=not process.leads) as advance:
        if process.leads:
            typer.echo(LICENCE_NOTICE, err=True)
        network = load_checkpoint(checkpoint).requires_grad_(True)
        pairs = finetune.mine_pairs(sequences, out, settings, process, advance)
        finetune.fine_tune(network, pairs, out, settings, process, advance)
    typer.echo(f"Export {out / finetune.WEIGHTS} with `aquaflow lab prior export mast3r`.")


def train_compact(
    out: Annotated[Path, typer.Option(help="Folder of scenes, checkpoint, curve and prior.")] = (
        Path("out/compact")
    ),
    steps: Annotated[int, typer.Option(min=1, help="Of the whole training.")] = 36_000,
    scenes: Annotated[int, typer.Option(min=8, help="Generated pairs; 3 a second.")] = 2400,
    batch: Annotated[int, typer.Option(min=2, help="Pairs of a step.")] = 8,
    seed: Annotated[int, typer.Option(help="Of scenes, water and order.")] = 1,
    pictures: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of real pictures or clips to learn from too; may be repeated."),
    ] = None,
    maps: Annotated[
        list[Path] | None,
        typer.Option(help="Dive folder whose map to learn from too, last; may be repeated."),
    ] = None,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(help="Finished dive or pictures to give figures for; may be repeated."),
    ] = None,
    size: Annotated[
        float, typer.Option(min=1.0, max=4.0, help="Weights, as a multiple of what ships.")
    ] = 1.0,
    start: Annotated[
        Path | None, typer.Option(help="Exported compact prior to start from; else at random.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.0, help="Highest learning rate; 2e-3, from a start 1e-4.")
    ] = None,
    workers: Annotated[int, typer.Option(min=0, help="Processes that render ahead.")] = 0,
    hours: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after so many; the same command goes on.")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Of torch.")] = 1,
    device: Annotated[str, typer.Option(help="cpu | cuda")] = "cpu",
    as_json: Json = False,
) -> None:
    """Train the compact prior on generated pictures and finished dives; resumes from --out.

    30 pairs a second on one core; set MALLOC_MMAP_THRESHOLD_ and MALLOC_TRIM_THRESHOLD_ to
    2000000000, or the pages of every step are given back and asked for again.
    """
    import torch

    from aquaflow.lab.training.compact import CompactSettings
    from aquaflow.lab.training.compact_run import PRIOR, RATE, RATE_FROM_START, CompactRun
    from aquaflow.lab.training.compact_run import train_compact as run_training

    torch.set_num_threads(usable_threads(threads))
    settings = CompactSettings(batch=batch, scenes=scenes, first_scenes=min(160, scenes))
    if rate is None:
        rate = RATE if start is None else RATE_FROM_START
    if start is not None:  # what it knows needs neither calm water nor the rate of random weights
        settings = replace(settings, calm_steps=0)
    run = CompactRun(
        rate=rate,
        seed=seed,
        steps=steps,
        settings=settings,
        pictures=tuple(pictures or ()),
        maps=tuple(maps or ()),
        held_out=tuple(held_out or ()),
        size=size,
        start=start,
        workers=workers,
    )
    with progress_bars(as_json) as advance:
        card = run_training(run, out, advance, device, hours)
    record = {} if card is None else card.training or {}
    if as_json:
        typer.echo(json.dumps(record))
    elif card is None:
        typer.echo(f"stopped after {hours} hours; give the same command to go on")
    else:
        typer.echo(f"written to {out / PRIOR}: {json.dumps(record['held_out'])}")


# --------------------------------------------------------------------------------------------------
# The command that makes a prior of the user's own depth network. Thin, like all of cli/.

DEFAULT_WIDTH, DEFAULT_HEIGHT = 518, 392
"""px: multiples of 14, as transformers of patches of 14 px need them."""


def describe(
    network: Annotated[Path, typer.Argument(help="ONNX file of a monocular depth network.")],
    out: Annotated[Path, typer.Option(help="New folder to write, for prior.folder.")],
    measure: Annotated[str, typer.Option(help="depth | inverse_depth | log_depth")],
    unit: Annotated[
        str, typer.Option(help="metres | unknown | affine (inverse depth up to scale and shift)")
    ],
    input_name: Annotated[str | None, typer.Option("--input", help="Name, if several.")] = None,
    output_name: Annotated[str | None, typer.Option("--output", help="Name, if several.")] = None,
    multiple: Annotated[
        int | None, typer.Option(min=1, help="px that sides of pictures are multiples of.")
    ] = None,
    width: Annotated[int, typer.Option(min=16, max=4096, help="px, if the network takes any.")] = (
        DEFAULT_WIDTH
    ),
    height: Annotated[int, typer.Option(min=16, max=4096, help="px, if the network takes any.")] = (
        DEFAULT_HEIGHT
    ),
    mean: Annotated[str, typer.Option(help="Of the channels in [0, 1].")] = "0.485,0.456,0.406",
    std: Annotated[str, typer.Option(help="Of the channels in [0, 1].")] = "0.229,0.224,0.225",
    channels: Annotated[str, typer.Option(help="rgb | bgr")] = "rgb",
    relative_error: Annotated[
        float, typer.Option(min=0.001, max=2.0, help="1 sigma of depth, as a share of it.")
    ] = 0.15,
    confidence: Annotated[str | None, typer.Option(help="Name of that output.")] = None,
    confidence_kind: Annotated[str, typer.Option(help="weight | sigma | log_variance")] = "weight",
    licence: Annotated[str, typer.Option(help="Of the network, for its card.")] = "not stated",
    as_json: Json = False,
) -> None:
    """Write a depth network of your own as a prior, after one test run."""
    from aquaflow.prior import describe as describing

    inputs, outputs = describing.names_of(network)
    taken = input_name or describing.only(list(inputs), "input", "--input")
    stated: dict[str, Any] = {
        "input": taken,
        "output": output_name or describing.only(outputs, "output", "--output"),
        "multiple_px": multiple or _multiple(inputs.get(taken, ())),
        "mean": _three(mean, "--mean"),
        "std": _three(std, "--std"),
        "channels": channels,
        "measure": measure,
        "unit": unit,
        "relative_error": relative_error,
        "confidence": confidence,
        "confidence_kind": confidence_kind,
    }
    card = describing.depth_card(stated)
    found = describing.describe(network, out, card, width, height, licence)
    result = {"width": found.width, "height": found.height, "ms": round(1e3 * found.seconds, 1)}
    if as_json:
        typer.echo(json.dumps({"folder": str(out), **result, "known": round(found.known, 3)}))
    else:
        typer.echo(
            f"written to {out}: {result['width']} x {result['height']} px in {result['ms']} ms, "
            f"{100.0 * found.known:.0f} % of the pixels with a depth; set prior.kind: folder and "
            f"prior.folder: {out}"
        )


def _multiple(shape: tuple[int | str, ...]) -> int:
    """Of a network that takes one size: any."""
    if len(shape) >= 2 and all(isinstance(side, int) for side in shape[-2:]):
        return 1
    raise InputError(
        "the network takes pictures of any size; give --multiple, the number of px that their "
        "sides must be multiples of (14 for Depth Anything)"
    )


def _three(text: str, option: str) -> tuple[float, ...]:
    """Three numbers with commas between them."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3:
        raise ArgumentError(f"{option} is {text!r}; give three numbers, as 0.5,0.5,0.5")
    return numbers


# --------------------------------------------------------------------------------------------------
# The command that checks a prior's files, here and where they are to run. Thin, as all of cli/.

MOST_RELATIVE = 1e-4
"""Difference between ONNX and torch, relative to an output's largest value, that is parity."""


DEVICES = ("cpu", "cuda", "tensorrt")
"""Processors that a prior may be verified on."""
PRECISIONS = ("fp32", "fp16", "int8")
"""Precisions that it may be verified in."""

Folder = Annotated[
    Path | None, typer.Argument(help="Exported prior; default: a tiny one, exported on the spot.")
]
Checkpoint = Annotated[
    Path | None,
    typer.Option(help="Weights to compare with; without, what was measured at export is shown."),
]
On = Annotated[
    str | None,
    typer.Option(help="cpu | cuda | tensorrt: run there, too, and compare with the CPU."),
]
In = Annotated[
    str, typer.Option(help="fp32 | fp16 | int8: of the run on --device; fp16 is TensorRT's.")
]


def verify(
    folder: Folder = None,
    checkpoint: Checkpoint = None,
    device: On = None,
    precision: In = "fp32",
    as_json: Json = False,
) -> None:
    """Compare every output of the ONNX files with torch's, and with --device what tracking gets
    there with what it gets from the CPU in 32 bits; exit code 1 where they differ."""
    from aquaflow.lab.networks.mast3r.export import verify_tiny
    from aquaflow.prior.describe import check, differences
    from aquaflow.prior.folder import read_card
    from aquaflow.prior.runtime import RuntimeSettings

    settings = None
    if device is not None:
        where: Any = one_of(DEVICES, device, "--device")
        how: Any = one_of(PRECISIONS, precision, "--precision")
        settings = RuntimeSettings(where, how)
    if folder is None and device is not None:
        raise ArgumentError(f"nothing to run on {device}; give the folder of a prior")
    if folder is None:
        with TemporaryDirectory() as scratch, progress_bars(as_json) as advance:
            name, parity = "mast3r (tiny)", verify_tiny(Path(scratch) / "prior", advance)
    else:
        card = read_card(folder)
        name, parity = card.name, card.parity
        if checkpoint is not None:
            parity = _parity_with(checkpoint, folder, card)
    there = {} if folder is None or settings is None else differences(folder, settings)
    print_parity(name, parity, there, as_json)
    worst = max(parity.values(), default=0.0)
    if not worst <= MOST_RELATIVE:
        raise AquaFlowError(
            f"prior {name} differs from torch by {worst:.1e}, more than {MOST_RELATIVE:.0e}; "
            "export it again"
        )
    if settings is not None:
        check(name, there, settings)


def _parity_with(checkpoint: Path, folder: Path, card: PriorCard) -> dict[str, float]:
    from aquaflow.lab.networks.compact import export as compact
    from aquaflow.lab.networks.mast3r import export as mast3r
    from aquaflow.lab.networks.mast3r.export import load_checkpoint

    if card.name == "compact":
        return compact.parity_of(compact.load_checkpoint(checkpoint), folder)
    if card.name == "mast3r":
        return mast3r.parity_of(load_checkpoint(checkpoint), folder, card.width, card.height)
    raise InputError(f"{folder} is of no network that we have in torch; leave out --checkpoint")


def print_parity(
    name: str, parity: dict[str, float], there: dict[str, float], as_json: bool
) -> None:
    """Both tables, or one JSON object."""
    if as_json:
        result: dict[str, Any] = {
            key: [{"prior": name, "name": output, "max_rel": x} for output, x in found.items()]
            for key, found in (("outputs", parity), ("on_device", there))
        }
        typer.echo(json.dumps(result))
        return
    for title, found in (("ONNX against torch", parity), ("device against CPU", there)):
        if found:
            _print_table(f"{name}: {title}", found)
    if not parity and not there:
        typer.echo(f"{name}: the files are whole; it is of no network that we have in torch")


def _print_table(title: str, found: dict[str, float]) -> None:
    from rich.table import Table

    table = Table(title=title)
    table.add_column("output")
    table.add_column("largest relative difference", justify="right")
    for output, difference in found.items():
        table.add_row(output, f"{difference:.1e}")
    table_console().print(table)
