"""The command that checks a prior's files, here and where they are to run. Thin, as all of cli/."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.cli.console import Json, one_of, progress_bars, table_console

if TYPE_CHECKING:
    from aquaflow.prior.folder import PriorCard

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
    from aquaflow.prior.folder import read_card
    from aquaflow.prior.mast3r.export import verify_tiny
    from aquaflow.prior.runtime import RuntimeSettings
    from aquaflow.prior.verification import check, differences

    settings = None
    if device is not None:
        where: Any = one_of(DEVICES, device, "--device")
        how: Any = one_of(PRECISIONS, precision, "--precision")
        settings = RuntimeSettings(where, how)
    if folder is None and device is not None:
        raise InputError(f"nothing to run on {device}; give the folder of a prior")
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
    from aquaflow.prior.compact import export as compact
    from aquaflow.prior.mast3r import export as mast3r
    from aquaflow.prior.mast3r.weights import load_checkpoint

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
