"""Writing a finished dive for other programs from Python, as ``aquaflow export`` does."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from aquaflow.dive.dive import Dive
from aquaflow.survey.export.formats import Exported, ExportRequest, export_dive, read_formats


def export(
    dive: Dive | str | os.PathLike[str],
    formats: str | Sequence[str],
    out: str | os.PathLike[str] | None = None,
    *,
    recording: str | os.PathLike[str] | None = None,
    restored: bool = False,
    water: bool = False,
    resolution: float | None = None,
    white_balance: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Write the largest sub-map of a finished dive; what formats share is drawn once.

    Args:
        dive: a folder, or what was read of it, which stays as it is.
        formats: ``"laz,ortho"`` or ``["laz", "ortho"]``, as ``--format`` takes them; ``"all"``: all
            that the dive has.
        out: folder to write to, or a file that ends as the format's does; None: the dive's folder.
        recording: what was mapped, if it no longer lies where it did.
        restored: pictures and points without water, where they are as the camera saw them.
        water: colours as seen through the water, where they are without it.
        resolution: side of a pixel or voxel in the dive's unit; None: as in the pictures.
        white_balance: of colours without water, such as ``"daylight"``.
        progress: called with a stage, the steps done and the number of steps.

    Returns:
        By format what ``--json`` says: ``out`` or ``files``, counts, ``unit``, ``axes``, ...

    Raises:
        InputError: there is no finished dive with a map, or a format cannot be written; the others
            are.
        ArgumentError: there is no such format, it does not know an option, or ``out`` is a file of
            another.
        ConfigError: the dive's settings cannot be read.
    """
    chosen = None if formats == "all" else read_formats(formats)
    request = ExportRequest(
        None if recording is None else Path(recording), restored, water, resolution, white_balance
    )
    made: list[Exported] = []
    export_dive(
        Dive(dive.path if isinstance(dive, Dive) else dive), chosen,
        None if out is None else Path(out), request, progress or (lambda *_: None), made.append,
    )  # fmt: skip
    return {each.format.value: each.facts for each in made}
