"""The command that calibrates a camera: ``calibrate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aquaflow.cli.console import Json

if TYPE_CHECKING:
    from aquaflow.calibration.board import Board
    from aquaflow.calibration.calibrate import Calibration


def calibrate(
    pictures: Annotated[
        Path | None, typer.Argument(help="Folder of pictures, or a video, of the board.")
    ] = None,
    board: Annotated[str, typer.Option(help="charuco | apriltag")] = "charuco",
    columns: Annotated[int, typer.Option(help="Squares, or tags, from left to right.")] = 9,
    rows: Annotated[int, typer.Option(help="Squares, or tags, from top to bottom.")] = 7,
    square_mm: Annotated[
        float, typer.Option(help="mm from one square, or tag, to the next, as measured.")
    ] = 30.0,
    model: Annotated[str, typer.Option(help="radtan | fisheye")] = "radtan",
    known: Annotated[
        Path | None, typer.Option(help="camera.yaml whose port is kept while the lens is found.")
    ] = None,
    estimate_port: Annotated[
        bool, typer.Option(help="Keep the lens of --known; find its flat port's place.")
    ] = False,
    print_board: Annotated[
        Path | None, typer.Option(help="Write the board to this .pdf or .png, and do no more.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("out/calibration"),
    as_json: Json = False,
) -> None:
    """Calibrate a camera from pictures of a ChArUco or AprilTag board."""
    if model not in ("radtan", "fisheye"):
        raise typer.BadParameter(f"--model {model!r} is neither radtan nor fisheye")
    if pictures is None and print_board is None:
        raise typer.BadParameter("give the pictures of the board, or --print-board to make one")
    made = _board(board, columns, rows, square_mm)
    if print_board is not None:
        from aquaflow.calibration.board import write_board

        write_board(made, print_board)
        typer.echo(
            f"Wrote {print_board}. Print it at its true size, glue it to something flat, and "
            f"measure the squares: {square_mm:g} mm."
        )
        return
    assert pictures is not None
    from aquaflow.calibration.calibrate import calibrate as find
    from aquaflow.calibration.calibrate import write_calibration
    from aquaflow.geometry.camera import load_camera

    camera = None if known is None else load_camera(known)
    found = find(
        pictures, made, "fisheye" if model == "fisheye" else "radtan", camera, estimate_port
    )
    files = write_calibration(found, out)
    if as_json:
        typer.echo(json.dumps({"out": str(out), **found.to_json()}))
        return
    typer.echo("\n".join(_in_words(found)))
    typer.echo(f"Wrote {', '.join(file.name for file in files)} to {out}.")


def _board(kind: str, columns: int, rows: int, square_mm: float) -> Board:
    """Raises typer.BadParameter for what is no board."""
    if kind not in ("charuco", "apriltag"):
        raise typer.BadParameter(f"--board {kind!r} is neither charuco nor apriltag")
    if not 1.0 <= square_mm <= 1000.0:
        raise typer.BadParameter("--square-mm must be between 1 and 1000 millimetres")
    from aquaflow.calibration.board import Board  # loads OpenCV

    return Board("charuco" if kind == "charuco" else "apriltag", columns, rows, 1e-3 * square_mm)


def _in_words(found: Calibration) -> list[str]:
    fit, views = found.fit, found.views
    lines = [
        f"{name:>10} {value:12.5g} +- {sigma:.2g}"
        for name, value, sigma in zip(fit.names, fit.values, fit.sigma, strict=True)
    ]
    lines.append(
        f"{len(views.used)} of {views.read} pictures used ({len(views.alike)} alike, "
        f"{len(views.without_board)} without the board), {fit.rms_px:.3f} px RMS, "
        f"{views.coverage:.0%} of the picture covered."
    )
    return lines
