"""A length that is known in metres and was measured in the map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import write_json
from aquaflow.optimise.robust import sigma_of

Array = npt.NDArray[np.float64]

LARGEST_DEVIATION = 3.5
"""Sigmas from the median beyond which one of three or more lengths contradicts the others."""


@dataclass(frozen=True)
class KnownLength:
    """Its ratio ``length_m / map_length`` is the scale of the map."""

    frame_index: int
    """Frame that it was measured in, or the nearest of several; -1: marked in the map itself."""
    source: str
    """What it is: ``marker 17``, ``laser dots``, ``scale bar``."""
    map_length: float
    map_sigma: float
    """Length in the map and its 1 sigma, map units."""
    length_m: float
    sigma_m: float
    """True length and its 1 sigma, metres."""
    sub_map: int = 0
    """Number of the sub-map that it was marked in."""

    @property
    def metres_per_unit(self) -> float:
        """The scale that follows from this length alone."""
        return self.length_m / self.map_length

    @property
    def relative_sigma(self) -> float:
        """1 sigma of ``metres_per_unit``, relative."""
        return float(np.hypot(self.map_sigma / self.map_length, self.sigma_m / self.length_m))


@dataclass(frozen=True)
class LengthScale:
    """The scale of one sub-map by all its known lengths."""

    metres_per_unit: float
    """Weighted mean of the lengths."""
    relative_sigma: float
    """1 sigma of it, relative."""
    used: int
    """Number of lengths that agree."""
    rejected: tuple[KnownLength, ...]
    """Lengths that contradict the others."""


def scale_of(lengths: Sequence[KnownLength]) -> LengthScale | None:
    """The weighted mean of the lengths of one sub-map, in the logarithm; None without any.

    Where they scatter by more than they state, their sigma grows with it: two that contradict each
    other leave the scale as uncertain as they are apart.
    """
    if not lengths:
        return None
    logs = np.log([length.metres_per_unit for length in lengths])
    sigmas = np.array([length.relative_sigma for length in lengths])
    good = np.ones(len(lengths), bool)
    if len(lengths) > 2:
        spread = max(sigma_of(logs - np.median(logs)), 1e-12)
        allowed = LARGEST_DEVIATION * np.maximum(sigmas, spread)
        good = np.abs(logs - np.median(logs)) <= allowed
    weights = 1.0 / sigmas[good] ** 2
    mean = float(weights @ logs[good] / weights.sum())
    sigma = float(1.0 / np.sqrt(weights.sum()))
    if good.sum() > 1:
        chi_square = float(weights @ (logs[good] - mean) ** 2)
        sigma *= max(1.0, float(np.sqrt(chi_square / (good.sum() - 1))))
    rejected = tuple(length for length, kept in zip(lengths, good, strict=True) if not kept)
    return LengthScale(float(np.exp(mean)), sigma, int(good.sum()), rejected)


# --------------------------------------------------------------------------------------------------
# known_lengths.json of a dive: what was measured, and the scale of each sub-map that follows.

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
