"""``aquaflow change``: two dives compared, and what changed between them as files."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow import __version__
from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import explain_refusal
from aquaflow.base.storage.table import csv_text
from aquaflow.dive.dive import Dive
from aquaflow.geometry.arrays import sim3_to_json
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.change.change_picture import change_png, write_change_raster
from aquaflow.survey.change.comparison import NOT_SEEN, UNCHANGED, SurfaceComparison, compare
from aquaflow.survey.change.moved import with_moves
from aquaflow.survey.change.patches import NAMES, Patch, find_patches
from aquaflow.survey.change.registration import Registration, register
from aquaflow.survey.change.surface import Progress, Surface, surface_of
from aquaflow.survey.export.ortho.geotiff import require_rasterio
from aquaflow.survey.export.ortho.ground import Ground, ground_of

FORMAT = 1
"""Of change.json; raised whenever an older AquaFlow could no longer read it."""
JSON, CSV, PNG = "change.json", "change.csv", "change.png"
START_RESOLUTIONS = 12.0
"""Distance up to which the second surface is looked for around the first, in resolutions: 0.3 m
where a picture shows 1.9 m; a merged site's dives lie within some centimetres."""


@dataclass(frozen=True)
class ChangeSettings:
    """What is compared, and how."""

    first: Path
    second: Path
    T_ab: Sim3
    """From the world of the second dive's map to that of the first's, as known before."""
    false_discoveries: float = 0.05
    """Share of the places that are called changed, at most, that did not."""
    cylinder: float | None = None
    reach: float | None = None
    """Of M3C2, in the first dive's unit; None: from the maps' resolution."""


@dataclass(frozen=True)
class Changes:
    """What was found."""

    asked: ChangeSettings
    ground: Ground
    registration: Registration
    compared: SurfaceComparison
    patches: list[Patch]
    surfaces: tuple[Surface, Surface]

    def to_json(self) -> dict[str, Any]:
        """The content of ``change.json`` (docs/formats.md#change)."""
        compared, moved = self.compared, self.registration
        scales, level = compared.scales, compared.distances.level()
        areas = {
            name: float((compared.kinds == kind).sum() * compared.area)
            for kind, name in {**NAMES, UNCHANGED: "unchanged", NOT_SEEN: "not seen"}.items()
        }
        return {
            "format": FORMAT,
            "from": self.asked.first.resolve().name, "to": self.asked.second.resolve().name,
            "unit": self.ground.unit, "epsg": self.ground.epsg, "axes": self.ground.axes,
            "vertical": self.ground.vertical,
            "normal_radius": scales.normal, "cylinder_radius": scales.cylinder,
            "reach": scales.reach, "resolution": scales.apart,
            "false_discovery_rate": self.asked.false_discoveries,
            "level_of_detection_median": _finite(np.nanmedian(level)),
            "sigmas_widened_by": compared.null[1],
            "registration": {
                "shared": moved.shared, "residual_sigma": moved.spread,
                **sim3_to_json(moved.T),
                "sigma": np.sqrt(np.diag(moved.covariance)).tolist(),
            },
            "light_ratio": list(compared.colours.gains),
            "areas": areas,
            "patches": self.rows(),
        }  # fmt: skip

    def rows(self) -> list[dict[str, Any]]:
        """The table, a patch a row."""
        return [row_of(n, patch, self.ground) for n, patch in enumerate(self.patches, 1)]


def find_changes(asked: ChangeSettings, work: Path, progress: Progress) -> Changes:
    """Compare two dives.

    Args:
        work: folder of files that end with the call.

    Raises:
        InputError: a dive has no map or no surface, or the two share too little ground.
        ConfigError: a dive's settings cannot be read.
    """
    earlier, later = Dive(asked.first), Dive(asked.second)
    one, frame, other = earlier.filled_map(), earlier.frame, later.filled_map()
    ground = ground_of(frame, one)
    first, voxel = surface_of(one, ground.T_gm, work, None, progress)
    second, _ = surface_of(other, ground.T_gm @ asked.T_ab, work, voxel, progress)
    resolution = max(first.resolution, second.resolution)
    registration = register(
        first.points, first.normals, second.points, resolution, START_RESOLUTIONS * resolution
    )
    second = second.move(registration.T)
    compared = compare(
        first, second, registration, asked.false_discoveries, asked.cylinder, asked.reach, progress
    )
    if not compared.distances.seen.any():
        raise InputError(
            f"no place is seen on both days, of {asked.first} and {asked.second}; compare dives "
            "over the same ground"
        )
    patches, compared = find_patches(compared, first, second)
    patches, compared = with_moves(patches, compared, first, second, registration)
    return Changes(asked, ground, registration, compared, patches, (first, second))


def write_changes(out: Path, found: Changes, overwrite: bool) -> list[Path]:
    """Write the four files into the folder ``out``: all of them, or none.

    Raises:
        InputError: ``out`` is taken, or cannot be written to.
    """
    require_rasterio()
    refuse_taken(out, overwrite)
    data = found.to_json()
    with explain_refusal(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
        try:
            write_change_raster(part, found.compared, found.ground, _tags(data))
            (part / CSV).write_bytes(csv_of(found.rows()))
            text = json.dumps(data, indent=2, allow_nan=False) + "\n"
            (part / JSON).write_text(text, encoding="utf-8")
            unit = found.ground.unit
            png = change_png(found.compared, found.patches, *found.surfaces, unit)
            (part / PNG).write_bytes(png)
            part.chmod(0o755)
            if out.exists():
                shutil.rmtree(out)
            part.replace(out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return sorted(out.iterdir())


def refuse_taken(out: Path, overwrite: bool) -> None:
    """Refuse a folder that holds something else, or changes that were not to be replaced.

    Raises:
        InputError: it does.
    """
    if out.is_dir() and not any(out.iterdir()):
        return
    if out.exists() and not (out / JSON).is_file():
        raise InputError(f"{out} holds files that are no changes; give another --out")
    if out.exists() and not overwrite:
        raise InputError(f"{out} holds changes already; give --overwrite, or another --out")


def _tags(data: dict[str, Any]) -> dict[str, str]:
    """What the raster says of itself, in words."""
    said = ("from", "to", "unit", "axes", "vertical", "false_discovery_rate")
    return {"SOFTWARE": f"AquaFlow {__version__}", **{key.upper(): str(data[key]) for key in said}}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


# --------------------------------------------------------------------------------------------------
# ``change.csv`` and ``change.json``: the patches as a table, and what all of it rests on.

Array = npt.NDArray[np.float64]

COLUMNS = (
    "number", "class", "x", "y", "height", "area", "volume", "volume_sigma", "distance",
    "distance_sigma", "brightness_ratio", "saturation_change", "chance", "partner", "moved_x",
    "moved_y", "moved_z", "moved", "moved_sigma",
)  # fmt: skip
DIGITS = 6


def row_of(number: int, patch: Patch, ground: Ground) -> dict[str, Any]:
    """A patch by column; None of what it does not have."""
    k, (x0, y0) = ground.grid_scale, ground.origin
    moved = patch.displacement
    values: tuple[Any, ...] = (
        number, NAMES[patch.kind], x0 + k * float(patch.place[0]), y0 + k * float(patch.place[1]),
        float(patch.place[2]), patch.area, patch.volume, patch.volume_sigma, patch.distance,
        patch.distance_sigma, math.exp(patch.lighter), patch.purer, patch.chance,
        None if patch.partner is None else patch.partner + 1,
        *((None,) * 3 if moved is None else moved),
        None if moved is None else float(np.linalg.norm(moved)), patch.displacement_sigma,
    )  # fmt: skip
    finite = (None if isinstance(v, float) and not math.isfinite(v) else v for v in values)
    row = dict(zip(COLUMNS, finite, strict=True))
    if row["volume"] is None:
        row["volume_sigma"] = None
    return row


def csv_of(rows: list[dict[str, Any]]) -> bytes:
    """The table with its head."""
    cells = ([_text(row[column]) for column in COLUMNS] for row in rows)
    return csv_text([COLUMNS, *cells]).encode("utf-8")


def _text(value: Any) -> str:
    if value is None:
        return ""
    # Coordinates on a UTM grid have seven digits before the point.
    return f"{value:.{DIGITS + 4}g}" if isinstance(value, float) else str(value)
