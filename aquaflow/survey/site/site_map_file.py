"""``map_N.ply`` and ``map_N.json``: the one map of a site's component N, a dive after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import write_json
from aquaflow.dive.ply import PlyGaussians, read_ply, write_ply
from aquaflow.geometry.similarity import Sim3

FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the files."""


@dataclass(frozen=True)
class SiteMapPart:
    """What the one map has of a dive."""

    name: str
    fingerprint: str
    """The dive, as it was merged."""
    T_sn: list[list[float]]
    """[4, 4], from the world of the dive's files to the map's."""
    gaussians: int
    """Number of its rows in the PLY, after those of the dives before."""
    gone: int
    """Number of Gaussians that later dives see past."""
    replaced: int
    """Number of Gaussians of places that another dive shows later, or in finer pixels."""
    gains: list[float]
    """[3] factors of the dive's colours."""


def names_of(site: Path, component: int) -> tuple[Path, Path]:
    """The PLY, and what says whose its rows are."""
    return site / f"map_{component}.ply", site / f"map_{component}.json"


def write_site_map(
    site: Path, component: int, parts: Sequence[SiteMapPart], gaussians: Sequence[PlyGaussians]
) -> None:
    """Write both files; ``gaussians``: of each part, all finite.

    Raises:
        InputError: a file cannot be written.
    """
    ply, about = names_of(site, component)
    about.unlink(missing_ok=True)  # it never speaks of another PLY
    write_ply(ply, join(gaussians))
    dives = [asdict(part) for part in parts]
    write_json(about, {"format": FORMAT, "component": component, "dives": dives})


def parts_of(
    site: Path,
    component: int,
    fingerprints: Mapping[str, str],
    T_sn: Mapping[str, Sim3],
) -> list[SiteMapPart] | None:
    """What the one map of a component is made of, if it is there and of these dives as they are.

    Args:
        fingerprints: of the dives as they were merged, by name.
        T_sn: of those that are asked for, by name.

    Raises:
        InputError: the file is damaged, or of a newer AquaFlow.
    """
    about = names_of(site, component)[1]
    if not about.is_file():
        return None
    try:
        data = read_regular_json(about)
        if data["format"] != FORMAT:
            raise InputError(
                f"{about} is not in format {FORMAT}, which this AquaFlow reads; update AquaFlow"
            )
        parts = [SiteMapPart(**stated) for stated in data["dives"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"cannot read {about}: {reason_of(error)}; run `aquaflow site map {site}` again"
        ) from error
    now = {name: (fingerprints.get(name), T.matrix.tolist()) for name, T in T_sn.items()}
    made_of = {part.name: (part.fingerprint, part.T_sn) for part in parts}
    return parts if made_of == now else None


def read_site_map(
    site: Path, component: int, parts: Sequence[SiteMapPart]
) -> dict[str, PlyGaussians]:
    """The Gaussians of each part of the one map, by the dive's name.

    Raises:
        InputError: the PLY is damaged, or another one.
    """
    ply, about = names_of(site, component)
    whole = read_ply(ply)
    ends = np.cumsum([part.gaussians for part in parts])
    if len(whole.means) != ends[-1]:
        raise InputError(f"{ply} is not what {about} says; run `aquaflow site map {site}` again")
    return {
        part.name: whole.rows(slice(end - part.gaussians, end))
        for part, end in zip(parts, ends.tolist(), strict=True)
    }


def join(gaussians: Sequence[PlyGaussians]) -> PlyGaussians:
    """All of them, one after the other."""
    means, wxyz, scales, opacities, colours = (
        np.concatenate([np.asarray(getattr(each, name), np.float32) for each in gaussians])
        for name in ("means", "wxyz", "scales", "opacities", "colours")
    )
    return PlyGaussians(means, wxyz, scales, opacities, colours)
