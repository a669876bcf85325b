"""The dives' paths in the worlds of a merged site, as TUM files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import make_subfolder
from aquaflow.dive.dive import Dive
from aquaflow.dive.tum import Trajectory, write_tum
from aquaflow.geometry.similarity import Sim3, Sim3Batch, quaternion_from_rotation
from aquaflow.survey.site.merged_file import MergedSite


def write_paths(
    site: Path, folders: Mapping[str, Path], merged: MergedSite, before: MergedSite | None = None
) -> None:
    """Write paths/DIVE_COMPONENT.tum for every dive and component that does not lie there as it did
    in the merge ``before``; those that nothing lies at any more are removed.

    Raises:
        InputError: a trajectory cannot be read, or a file cannot be written.
    """
    written = set()
    there = {path.name for path in (site / FOLDER).glob("*.tum")}
    for index, name in enumerate(merged.fingerprints):
        names = {f"{name}_{placed.component}.tum" for placed in merged.of_dive(name)}
        if before is not None and names <= there and _is_unmoved(merged, before, name):
            written |= {site / FOLDER / each for each in names}
            continue
        for component, path in _paths_of(folders[name], index, name, merged).items():
            target = site / FOLDER / f"{name}_{component}.tum"
            _make(target.parent)
            unit = merged.components[component]["unit"]
            comment = f"camera to the world of component {component} of the site; unit: {unit}"
            write_tum(target, path.t_s, path.positions, path.wxyz, comment=comment)
            written.add(target)
    for old in (site / FOLDER).glob("*.tum"):
        if old not in written:
            old.unlink(missing_ok=True)


def _is_unmoved(merged: MergedSite, before: MergedSite, dive: str) -> bool:
    """Whether a dive lies where it did, in the same unit."""
    units = [
        [each.components[placed.component]["unit"] for placed in each.of_dive(dive)]
        for each in (merged, before)
    ]
    return units[0] == units[1] and all(
        merged.has_as(before, dive, placed.number) for placed in merged.of_dive(dive)
    )


def _paths_of(folder: Path, index: int, name: str, merged: MergedSite) -> dict[int, Trajectory]:
    """The path of a dive by component."""
    dive = Dive(folder)
    sub_maps = sub_maps_of_frames(dive)
    parts: dict[int, list[Trajectory]] = {}
    for placed in merged.of_dive(name):
        path = path_of_sub_map(dive, placed.number, sub_maps)
        if not len(path):
            continue
        frame = dive.frame_of(placed.number)
        places = [place for place in dive.places.places if place.sub_map == placed.number]
        rows = merged.keyframes[
            (merged.keyframes["dive"] == index) & (merged.keyframes["sub_map"] == placed.number)
        ]
        before = [frame.T_nm @ place.T_mc for place in places]
        after = [Sim3(row["R"], row["t"], float(row["scale"])) for row in rows]
        times = 1e-9 * rows["t_ns"]
        order = np.argsort(times, kind="stable")
        parts.setdefault(placed.component, []).append(
            moved_path(path, times[order], [before[i] for i in order], [after[i] for i in order])
        )
    return {component: _together(each) for component, each in parts.items()}


def _together(parts: list[Trajectory]) -> Trajectory:
    """In the order of their times."""
    t_s = np.concatenate([part.t_s for part in parts])
    positions = np.concatenate([part.positions for part in parts])
    wxyz = np.concatenate([part.wxyz for part in parts])
    return Trajectory(t_s, positions, wxyz).select(np.argsort(t_s, kind="stable"))


def _make(folder: Path) -> None:
    try:
        make_subfolder(folder)
    except OSError as error:
        raise InputError(f"cannot make {folder}: {error.strerror}; make room") from error


# --------------------------------------------------------------------------------------------------
# Every frame's pose in a component's world: a dive's trajectory, bent as its keyframes were.

Array = npt.NDArray[np.float64]

FOLDER = "paths"
"""In a site: DIVE_COMPONENT.tum."""


def sub_maps_of_frames(dive: Dive) -> dict[int, int]:
    """The sub-map of each posed frame by its time, microseconds.

    Raises:
        InputError: the table of frames cannot be read.
    """
    return {_microsecond(row.t_s): row.sub_map for row in dive.frames if row.sub_map is not None}


def moved_path(
    path: Trajectory,
    times_s: Array,  # [K] of the keyframes, increasing
    before: Sequence[Sim3],
    after: Sequence[Sim3],
) -> Trajectory:
    """The poses of ``path``, each moved as the keyframes before and after it were.

    Between two keyframes the moves are interpolated along the similarity that takes one to the
    other; before the first and after the last that one's move is used.
    """
    moves = Sim3Batch.of(after) @ Sim3Batch.of(before).inverse()
    last = np.clip(np.searchsorted(times_s, path.t_s, side="right"), 1, len(times_s)) - 1
    following = np.minimum(last + 1, len(times_s) - 1)
    span = times_s[following] - times_s[last]
    share = np.where(span > 0.0, (path.t_s - times_s[last]) / np.where(span > 0.0, span, 1.0), 0.0)
    start = moves[last]
    way = (start.inverse() @ moves[following]).log()
    move = start @ Sim3Batch.exp(np.clip(share, 0.0, 1.0)[:, None] * way)
    positions = move.scale[:, None] * np.einsum("nij,nj->ni", move.R, path.positions) + move.t
    return Trajectory(path.t_s, positions, quaternion_from_rotation(move.R @ path.R_wc))


def path_of_sub_map(dive: Dive, sub_map: int, sub_maps: dict[int, int]) -> Trajectory:
    """The part of a dive's trajectory that is in ``sub_map``, in n.

    Raises:
        InputError: it cannot be read.
    """
    path = dive.trajectory
    there = [sub_maps.get(_microsecond(float(t))) == sub_map for t in path.t_s]
    return path.select(np.array(there, dtype=bool))


def _microsecond(t_s: float) -> int:
    return round(t_s * 1e6)
