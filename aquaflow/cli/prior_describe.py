"""The command that makes a prior of the user's own depth network. Thin, like all of cli/."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from aquaflow.base.errors import InputError
from aquaflow.cli.console import Json

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
        raise InputError(f"{option} is {text!r}; give three numbers, as 0.5,0.5,0.5")
    return numbers
