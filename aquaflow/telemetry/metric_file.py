"""``metric.json``: how each sub-map of a dive lies in the world, for exports and for reading back.

The file keeps ``T_nm``, from a sub-map's internal world to n, in which all other files of the dive
are written; ``map.aqf`` and checkpoints keep the internal world.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import numpy as np

from aquaflow.base.errors import DamagedError, InputError, reason_or_key
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import write_json
from aquaflow.geometry.arrays import sim3_from_json, sim3_to_json
from aquaflow.telemetry.world_frame import North, Origin, SourceReport, WorldFrame

NAME = "metric.json"
FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""
ROTATION_TOLERANCE = 1e-6
"""Largest difference of R^T R from the identity: rounding of 17 digits is far below."""


def write_metric_file(folder: Path, frames: Mapping[int, WorldFrame], main: int) -> None:
    """Write the frames by sub-map; ``main`` is the sub-map of ``map.aqf``.

    Raises:
        InputError: the file cannot be written.
        ValueError: a number is not finite.
    """
    sub_maps = {
        str(number): {"map": map_name(number, main), **frame_to_json(frame)}
        for number, frame in sorted(frames.items())
    }
    write_json(folder / NAME, {"format": FORMAT, "main": main, "sub_maps": sub_maps})


def read_metric_file(folder: Path) -> dict[int, WorldFrame]:
    """The frames by sub-map; empty for a dive without the file: of a peer, or an older one.

    Raises:
        InputError: the file is damaged, or of a newer AquaFlow.
    """
    return {number: frame for number, (_, frame) in _read(folder).items()}


def read_main(folder: Path) -> int:
    """The sub-map of ``map.aqf``; 0 for a dive without the file.

    Raises:
        InputError: the file is damaged, or of a newer AquaFlow.
    """
    return next((number for number, (name, _) in _read(folder).items() if name == "map.aqf"), 0)


def read_frame_of_map(map_file: Path) -> WorldFrame:
    """The frame of the sub-map in ``map_file``, ``map.aqf`` or ``map_N.aqf`` of a dive folder.

    Raises:
        InputError: the dive's ``metric.json`` is damaged, or of a newer AquaFlow.
    """
    found = [frame for name, frame in _read(map_file.parent).values() if name == map_file.name]
    return found[0] if found else WorldFrame.unknown()


def map_name(number: int, main: int) -> str:
    """The map file of a sub-map in its dive folder; ``main`` is the sub-map of ``map.aqf``."""
    return "map.aqf" if number == main else f"map_{number}.aqf"


def frame_to_json(frame: WorldFrame) -> dict[str, Any]:
    """The frame as plain values, for this file and for checkpoints."""
    T, T_bc = frame.T_nm, frame.T_bc
    return {
        "unit": frame.unit,
        "metric": bool(frame.metric),  # a comparison of NumPy's numbers is no JSON
        "level": bool(frame.level),
        "north": frame.north,
        "depth_known": bool(frame.depth_known),
        "T_nm": sim3_to_json(T),
        "covariance": frame.covariance.tolist(),
        "T_bc": None if T_bc is None else sim3_to_json(T_bc),
        "origin": None if frame.origin is None else asdict(frame.origin),
        "scale_source": frame.scale_source,
        "sources": [asdict(source) for source in frame.sources],
        **({"on_ground": True} if frame.on_ground else {}),
        **({"clock_offset_s": frame.clock_offset_s} if frame.clock_offset_s else {}),
        **({"site": frame.site} if frame.site else {}),
    }


def _read(folder: Path) -> dict[int, tuple[str, WorldFrame]]:
    """Map file and frame by sub-map."""
    path = folder / NAME
    if not path.is_file():
        return {}
    try:
        data = read_regular_json(path)
        if not isinstance(data["format"], int):
            raise DamagedError("its format is no number")
        if data["format"] == FORMAT:
            return {
                int(number): (str(stated["map"]), frame_of_json(stated))
                for number, stated in data["sub_maps"].items()
            }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"cannot read {path}: {reason_or_key(error)}; map the dive again"
        raise InputError(why) from error
    raise InputError(
        f"{path} has format {data['format']}, this AquaFlow reads format {FORMAT}; update AquaFlow"
    )


def frame_of_json(stated: dict[str, Any]) -> WorldFrame:
    """The frame that :func:`frame_to_json` made.

    Raises:
        DamagedError, KeyError, TypeError, ValueError: it is none.
    """
    covariance = np.asarray(stated["covariance"], np.float64)
    if covariance.shape != (7, 7) or not np.isfinite(covariance).all():
        raise DamagedError("a covariance is not 7 x 7 finite numbers")
    if stated["north"] not in get_args(North):
        raise DamagedError("north is none of the words that the format has")
    origin, T_bc = stated["origin"], stated["T_bc"]
    return WorldFrame(
        T_nm=sim3_from_json(stated["T_nm"]),
        covariance=covariance,
        metric=bool(stated["metric"]),
        level=bool(stated["level"]),
        on_ground=bool(stated.get("on_ground", False)),
        north=stated["north"],
        depth_known=bool(stated["depth_known"]),
        origin=None if origin is None else Origin(**origin),
        T_bc=None if T_bc is None else sim3_from_json(T_bc),
        scale_source=str(stated["scale_source"]),
        sources=tuple(SourceReport(**source) for source in stated["sources"]),
        clock_offset_s=float(stated.get("clock_offset_s", 0.0)),
        site=str(stated.get("site", "")),
    )
