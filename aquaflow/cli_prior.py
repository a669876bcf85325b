"""The commands of the two-view prior: export and verify. Thin, like cli.py."""

from __future__ import annotations

import json
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from aquaflow.errors import AquaFlowError
from aquaflow.terminal import Json, progress_bars, table_console

MOST_RELATIVE = 1e-4
"""Difference between ONNX and torch, relative to an output's largest value, that is parity."""

Folder = Annotated[
    Path | None, typer.Argument(help="Exported prior; default: a tiny one, exported on the spot.")
]


Checkpoint = Annotated[
    Path | None,
    typer.Option(help="Weights to compare with; without, what was measured at export is shown."),
]


class Exported(str, Enum):
    """Networks that can be exported."""

    mast3r = "mast3r"


def register(app: typer.Typer) -> None:
    """Add the commands to ``app``."""
    prior = typer.Typer(help="The two-view prior: export, verify.", no_args_is_help=True)
    prior.command()(export)
    prior.command()(verify)
    app.add_typer(prior, name="prior")


def export(
    network: Annotated[Exported, typer.Argument(help="Which network.")],
    checkpoint: Annotated[Path, typer.Option(help="The public .pth file, which you bring.")],
    out: Annotated[Path, typer.Option(help="New folder to write.")] = Path("out/prior"),
    width: Annotated[int, typer.Option(help="px of the pictures, a multiple of 16.")] = 512,
    height: Annotated[int, typer.Option(help="px, a multiple of 16.")] = 384,
    as_json: Json = False,
) -> None:
    """Write encoder.onnx, decoder.onnx and prior.json for pictures of one size."""
    from aquaflow.prior.mast3r.export import export as export_mast3r
    from aquaflow.prior.mast3r.weights import LICENCE_NOTICE, load_checkpoint

    del network  # there is one so far
    typer.echo(LICENCE_NOTICE, err=True)
    with progress_bars(as_json) as advance:
        model = load_checkpoint(checkpoint)
        card = export_mast3r(model, out, width, height, LICENCE_NOTICE, advance)
    _report(card.name, card.parity, as_json)
    if not as_json:
        typer.echo(f"written to {out}")


def verify(folder: Folder = None, checkpoint: Checkpoint = None, as_json: Json = False) -> None:
    """Compare every output of the ONNX files with torch's; exit code 1 beyond 1e-4."""
    from aquaflow.prior.folder import read_card
    from aquaflow.prior.mast3r.export import parity_of, verify_tiny
    from aquaflow.prior.mast3r.weights import load_checkpoint

    if folder is None:
        with TemporaryDirectory() as scratch, progress_bars(as_json) as advance:
            name, parity = "mast3r (tiny)", verify_tiny(Path(scratch) / "prior", advance)
    else:
        card = read_card(folder)
        name, parity = card.name, card.parity
        if checkpoint is not None:
            parity = parity_of(load_checkpoint(checkpoint), folder, card.width, card.height)
    _report(name, parity, as_json)
    worst = max(parity.values())
    if not worst <= MOST_RELATIVE:
        raise AquaFlowError(
            f"prior {name} differs from torch by {worst:.1e}, more than {MOST_RELATIVE:.0e}; "
            "export it again"
        )


def _report(name: str, parity: dict[str, float], as_json: bool) -> None:
    if as_json:
        outputs = [{"prior": name, "name": output, "max_rel": x} for output, x in parity.items()]
        typer.echo(json.dumps({"outputs": outputs}))
        return
    from rich.table import Table

    table = Table(title=f"{name}: ONNX against torch")
    table.add_column("output")
    table.add_column("largest relative difference", justify="right")
    for output, difference in parity.items():
        table.add_row(output, f"{difference:.1e}")
    table_console().print(table)
