"""known_lengths.json of a dive: what was measured, and the scale of each sub-map that follows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import write_json
from aquaflow.telemetry.known_lengths.known_length import KnownLength, scale_of

FILE = "known_lengths.json"
"""In the dive folder."""


def read_known_lengths(dive: Path) -> list[KnownLength]:
    """The lengths of the dive; none where there is no such file.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    path = dive / FILE
    try:
        listed = read_regular_json(path)["lengths"]
        return [_length(each) for each in listed]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path} does not hold known lengths ({reason_of(error)}); remove it and measure again"
        ) from error


def write_known_lengths(dive: Path, lengths: Sequence[KnownLength]) -> None:
    """Write the lengths, and for each sub-map its metres per map unit.

    Raises:
        InputError: the file cannot be written.
    """
    scales: list[dict[str, Any]] = []
    for sub_map in sorted({length.sub_map for length in lengths}):
        scale = scale_of([length for length in lengths if length.sub_map == sub_map])
        assert scale is not None
        rejected = [{"frame_index": r.frame_index, "source": r.source} for r in scale.rejected]
        scales.append(asdict(scale) | {"sub_map": sub_map, "rejected": rejected})
    data = {"lengths": [asdict(length) for length in lengths], "scales": scales}
    write_json(dive / FILE, data)


def with_length(lengths: Sequence[KnownLength], new: KnownLength) -> list[KnownLength]:
    """The lengths with ``new``, which replaces an earlier measurement of the same."""
    same = (new.frame_index, new.source, new.sub_map)
    kept = [each for each in lengths if (each.frame_index, each.source, each.sub_map) != same]
    return [*kept, new]


def _length(entry: dict[str, Any]) -> KnownLength:
    """Raises ValueError, KeyError or TypeError for what is none."""
    map_length, map_sigma, length_m, sigma_m = (
        float(entry[name]) for name in ("map_length", "map_sigma", "length_m", "sigma_m")
    )
    if not all(math.isfinite(v) and v > 0.0 for v in (map_length, map_sigma, length_m, sigma_m)):
        raise ValueError("a length or its sigma is not positive")
    return KnownLength(
        int(entry["frame_index"]), str(entry["source"]),
        map_length, map_sigma, length_m, sigma_m, int(entry["sub_map"]),
    )  # fmt: skip
