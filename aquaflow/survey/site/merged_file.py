"""``merged.json`` and ``merged.npy``: how the dives of a site lie to each other."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.archive import read_array_file
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.dive import Dive
from aquaflow.geometry.arrays import sim3_from_json, sim3_to_json
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.site.manifest import SiteDive

NAME, ARRAYS = "merged.json", "merged.npy"
"""In a site's folder."""
FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the files."""
KEYFRAME = np.dtype(
    [
        ("dive", "<i4"),
        ("number", "<i8"),
        ("sub_map", "<i4"),
        ("component", "<i4"),
        ("t_ns", "<i8"),
        ("R", "<f8", (3, 3)),
        ("t", "<f8", (3,)),
        ("scale", "<f8"),
    ]
)
"""A keyframe: index of its dive in ``dives``, and T_sc, camera to its component's world."""

Rows = npt.NDArray[Any]


@dataclass(frozen=True)
class PlacedSubMap:
    """A sub-map of a dive in its component's world."""

    dive: str
    """Its name."""
    number: int
    """Sub-map in its dive."""
    component: int
    """Component that it lies in."""
    T_sm: Sim3
    """From the world of the sub-map's ``map.aqf``."""
    T_sn: Sim3
    """From the world of the dive's ``trajectory.tum`` and ``map.ply``."""
    keyframes: int
    """Number of them."""
    bent: float
    """Root mean square distance by which its keyframes differ from that one similarity: the joint
    optimisation bends a path that drifted."""


@dataclass(frozen=True)
class MergedSite:
    """What a merge found."""

    fingerprints: Mapping[str, str]
    """Of the dives that were merged, by name and in order."""
    left_out: Mapping[str, str]
    """Dives that could not take part: name and reason."""
    components: tuple[dict[str, Any], ...]
    """By number: what is known of their worlds."""
    sub_maps: tuple[PlacedSubMap, ...]
    links: tuple[dict[str, Any], ...]
    """Every link that was found, its evidence and its verdict."""
    keyframes: Rows
    """[N] KEYFRAME"""

    def of_dive(self, name: str) -> tuple[PlacedSubMap, ...]:
        """The sub-maps of a dive."""
        return tuple(each for each in self.sub_maps if each.dive == name)

    @cached_property
    def _rows(self) -> dict[tuple[str, int], slice]:
        """Where the keyframes of a dive's sub-map stand: they follow each other."""
        names, rows = list(self.fingerprints), self.keyframes
        ends = np.flatnonzero(np.diff(rows["dive"]) | np.diff(rows["sub_map"])) + 1
        bounds = [0, *ends.tolist(), len(rows)] if len(rows) else []
        firsts = [(int(rows[first]["dive"]), int(rows[first]["sub_map"])) for first in bounds[:-1]]
        return {
            (names[dive], sub_map): slice(*own)
            for (dive, sub_map), own in zip(firsts, pairwise(bounds), strict=True)
        }

    def rows_of(self, dive: str, sub_map: int) -> Rows:
        """[K] KEYFRAME: the keyframes of a sub-map; none of one that was not merged."""
        return np.asarray(self.keyframes[self._rows.get((dive, sub_map), slice(0, 0))])

    def has_as(self, other: MergedSite, dive: str, sub_map: int) -> bool:
        """True if a sub-map lies here as in another merge of the same dive."""
        here, there = (np.copy(each.rows_of(dive, sub_map)) for each in (self, other))
        here["dive"] = there["dive"] = 0  # its number among the dives is another thing
        same = here.tobytes() == there.tobytes()
        return same and self.fingerprints.get(dive) == other.fingerprints.get(dive)

    def choose(self, component: int | None, site: Path) -> int:
        """The component that was asked for; None: the one with most keyframes.

        Raises:
            InputError: there is no such component.
        """
        count = len(self.components)
        if component is None:
            return int(np.bincount(self.keyframes["component"], minlength=count).argmax())
        if not 0 <= component < count:
            raise InputError(
                f"{site} has components 0 to {count - 1}, not {component}; `aquaflow site list "
                f"{site}` shows them"
            )
        return component

    def main_of(self, dive: SiteDive, site: Path) -> PlacedSubMap | None:
        """The sub-map of a dive's ``map.ply``; None where the merge has none.

        Raises:
            InputError: the dive's metric.json is damaged.
        """
        main = Dive(dive.folder(site)).main
        return next((each for each in self.of_dive(dive.name) if each.number == main), None)


def remove_merged(site: Path) -> None:
    """Remove what says that the site was merged, before any other file of the merge is written.

    Raises:
        InputError: it cannot be removed.
    """
    try:
        (site / NAME).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot remove {site / NAME}: {error.strerror}") from error


def write_merged(site: Path, merged: MergedSite) -> None:
    """Write both files; ``merged.json``, after :func:`remove_merged`, last: where it is, all is.

    Raises:
        InputError: a file cannot be written.
    """
    with atomic_write(site / ARRAYS) as stream:
        np.lib.format.write_array(stream, merged.keyframes, allow_pickle=False)
    sub_maps = [
        vars(each) | {"T_sm": sim3_to_json(each.T_sm), "T_sn": sim3_to_json(each.T_sn)}
        for each in merged.sub_maps
    ]
    stated = {
        "format": FORMAT, "dives": dict(merged.fingerprints), "left_out": dict(merged.left_out),
    }  # fmt: skip
    text = json.dumps(stated, indent=2, allow_nan=False).removesuffix("\n}")
    for name, rows in (
        ("components", merged.components), ("sub_maps", sub_maps), ("links", merged.links),
    ):  # fmt: skip
        # Each a line: without indentation Python's encoder is compiled, and takes a tenth.
        lines = ",".join(f"\n    {_ENCODER.encode(each)}" for each in rows)
        text += f',\n  "{name}": [{lines}\n  ]'
    with atomic_write(site / NAME) as stream:
        stream.write(f"{text}\n}}\n".encode())


_ENCODER = json.JSONEncoder(allow_nan=False)


def read_merged(site: Path) -> MergedSite | None:
    """What the last merge found; None before the first.

    Raises:
        InputError: a file is damaged, or of a newer AquaFlow.
    """
    path = site / NAME
    if not path.is_file():
        return None
    try:
        data = read_regular_json(path)
        if data["format"] != FORMAT:
            raise InputError(
                f"{path} is not in format {FORMAT}, which this AquaFlow reads; update AquaFlow"
            )
        return _merge(data, _keyframes(site / ARRAYS))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError) as error:
        raise InputError(
            f"cannot read {path}: {reason_of(error)}; run `aquaflow site merge` again"
        ) from error


def merge_of(site: Path) -> MergedSite:
    """What the last merge found.

    Raises:
        InputError: there was none, or a file is damaged, or of a newer AquaFlow.
    """
    merged = read_merged(site)
    if merged is None:
        raise InputError(
            f"{site} was never merged, or that was cut off; run `aquaflow site merge {site}` first"
        )
    return merged


def _keyframes(path: Path) -> Rows:
    rows = read_array_file(path)
    if rows.dtype != KEYFRAME or rows.ndim != 1:
        raise DamagedError(f"{path.name} holds no keyframes")
    return np.asarray(rows)


def _merge(
    data: dict[str, Any],
    keyframes: Rows,  # [N] KEYFRAME
) -> MergedSite:
    sub_maps = tuple(
        PlacedSubMap(
            str(each["dive"]), int(each["number"]), int(each["component"]),
            sim3_from_json(each["T_sm"]), sim3_from_json(each["T_sn"]),
            int(each["keyframes"]), float(each["bent"]),
        )
        for each in data["sub_maps"]
    )  # fmt: skip
    return MergedSite(
        dict(data["dives"]), dict(data["left_out"]), tuple(data["components"]), sub_maps,
        tuple(data["links"]), keyframes,
    )  # fmt: skip
