"""``aquaflow site merge``: the dives of a site recognised in each other and optimised together.

Links of a pair of dives are kept on disk as soon as they are found: a merge that was cut off goes
on with the next pair, and a dive added later is compared with the others alone. The rest takes
seconds, is done anew each time, and gives the same bytes for the same dives.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.base.storage.atomic import make_subfolder, open_to_append, write_json
from aquaflow.base.storage.whole_folder import FolderLock
from aquaflow.dive.dive import Dive
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import PlacesFile
from aquaflow.survey.site.joining import CrossLink, find_links, join
from aquaflow.survey.site.joint_graph import JointGraph, by_knowledge, sub_maps_of
from aquaflow.survey.site.manifest import NAME, SiteDive, add_dives, read_site, state_of
from aquaflow.survey.site.merged_file import MergedSite, remove_merged, write_merged
from aquaflow.survey.site.placing import place
from aquaflow.survey.site.site_paths import write_paths
from aquaflow.telemetry.world_frame import WorldFrame

Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class Taking:
    """A dive that takes part in a merge."""

    dive: SiteDive
    folder: Path
    places: PlacesFile
    frames: dict[int, WorldFrame]


def merge(site: Path, progress: Progress = lambda *_: None) -> MergedSite:
    """Merge the dives of the site in the folder ``site`` and write what was found into it.

    A dive that changed since it was added, is missing or damaged is left out, and named.

    Raises:
        InputError: there is no site, no dive of it can be used, another process writes to it, or a
            file cannot be written.
    """
    dives = read_site(site)
    lock = FolderLock(site)
    try:
        taking, left_out = _taking(site, dives)
        found = _links(site, taking, progress)
        merged = _merge(taking, left_out, found)
        remove_merged(site)
        write_paths(site, {each.dive.name: each.folder for each in taking}, merged)
        write_merged(site, merged)
        say(site, "merged", dives=len(taking), components=len(merged.components))
    finally:
        lock.release()
    return merged


def _taking(site: Path, dives: Sequence[SiteDive]) -> tuple[list[Taking], dict[str, str]]:
    taking, left_out = [], {}
    for dive in dives:
        folder = dive.folder(site)
        try:
            state = state_of(site, dive)
            if state != "as added":
                left_out[dive.name] = _WHY[state]
                continue
            read = Dive(folder)
            taking.append(Taking(dive, folder, read.places, dict(read.metric_frames)))
        except InputError as error:
            left_out[dive.name] = str(error)
    if not taking:
        why = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise InputError(f"{site} has no dive that can be merged ({why or 'it is empty'})")
    return taking, left_out


_WHY = {
    "changed": "it changed since it was added; add it again to use it as it is now",
    "missing": "its folder or its places.npz is gone; put it back, or map the dive again",
}


def _links(
    site: Path, taking: Sequence[Taking], progress: Progress
) -> dict[tuple[int, int], list[CrossLink]]:
    found = {}
    for i, j in combinations(range(len(taking)), 2):
        a, b = taking[i], taking[j]
        path = link_file(site, a.dive, b.dive)
        links = read_links(path, a.dive, b.dive)
        if links is None:
            stage = f"{a.dive.name} - {b.dive.name}"

            def advance(done: int, total: int, stage: str = stage) -> None:
                progress(stage, done, total)

            links = find_links(a.places, b.places, advance)
            write_links(path, a.dive, b.dive, links)
            say(site, "compared", a=a.dive.name, b=b.dive.name, links=len(links))
        found[i, j] = links
    return found


def _merge(
    taking: Sequence[Taking],
    left_out: dict[str, str],
    found: dict[tuple[int, int], list[CrossLink]],
) -> MergedSite:
    files = [each.places for each in taking]
    sub_maps = [
        sub_map
        for index, each in enumerate(taking)
        for sub_map in sub_maps_of(index, each.places, each.frames)
    ]
    joint = JointGraph(sorted(sub_maps, key=by_knowledge), files)
    judged = join(joint, found)
    return place(joint, [each.dive for each in taking], left_out, judged)


# --------------------------------------------------------------------------------------------------
# Links of two dives on disk, so that a merge which was cut off, or gets one dive more, goes on.

FOLDER = "links"
"""In a site."""
METHOD = 2
"""Raised whenever the same dives would give other links."""


def link_file(site: Path, a: SiteDive, b: SiteDive) -> Path:
    """The file of the links between two dives."""
    return site / FOLDER / f"{a.fingerprint[:16]}_{b.fingerprint[:16]}.json"


def write_links(path: Path, a: SiteDive, b: SiteDive, links: list[CrossLink]) -> None:
    """Write the links between two dives, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        make_subfolder(path.parent)
    except OSError as error:
        raise InputError(f"cannot make {path.parent}: {error.strerror}; make room") from error
    write_json(path, {"of": _of(a, b), "links": [_to_json(link) for link in links]})


def read_links(path: Path, a: SiteDive, b: SiteDive) -> list[CrossLink] | None:
    """The links between two dives as they are now; None where they are to be looked for."""
    try:
        data = read_regular_json(path, folders=1)
        if data["of"] != _of(a, b):
            return None
        return [_of_json(stated) for stated in data["links"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _of(a: SiteDive, b: SiteDive) -> list[Any]:
    return [METHOD, a.fingerprint, b.fingerprint]


def _to_json(link: CrossLink) -> dict[str, Any]:
    T = link.T_ba
    return {
        "a": link.a, "b": link.b, "R": T.R.tolist(), "t": T.t.tolist(), "scale": float(T.scale),
        "information": link.information.tolist(), "inliers": link.inliers,
        "matched": link.matched, "cells": link.cells, "similarity": link.similarity,
    }  # fmt: skip


def _of_json(stated: dict[str, Any]) -> CrossLink:
    T = Sim3(np.array(stated["R"]), np.array(stated["t"]), float(stated["scale"]))
    information = np.array(stated["information"], np.float64)
    if T.R.shape != (3, 3) or T.t.shape != (3,) or information.shape != (7, 7):
        raise ValueError("it is no link")
    inliers, matched, cells = (int(stated[name]) for name in ("inliers", "matched", "cells"))
    return CrossLink(
        int(stated["a"]), int(stated["b"]), T, information, inliers, matched, cells,
        float(stated["similarity"]),
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------
# ``aquaflow site add``: dives into a site, by one process at a time.


def add_to_site(site: Path, folders: Sequence[Path]) -> list[SiteDive]:
    """Add dive folders to the site, which is made if it is not there; the dives that are new, or
    were mapped again since they were added. The dives themselves are not touched.

    Raises:
        InputError: a folder is no finished dive, another process writes to the site, or it cannot
            be read or written.
    """
    lock = FolderLock(site) if (site / NAME).exists() else None
    try:
        new = add_dives(site, folders)
    finally:
        if lock is not None:
            lock.release()
    for dive in new:
        say(site, "added", dive=dive.name, fingerprint=dive.fingerprint)
    return new


# --------------------------------------------------------------------------------------------------
# ``log.jsonl`` of a site: what was done to it, a line each.

log = logging.getLogger(__name__)

SITE_LOG = "log.jsonl"
"""In a site's folder."""


def say(site: Path, event: str, **facts: str | int) -> None:
    """Append a line; a log that cannot be written costs nothing else."""
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    line = json.dumps({"utc": now, "event": event, **facts}) + "\n"
    try:
        with open_to_append(site / SITE_LOG) as stream:
            stream.write(line.encode())
    except OSError as error:
        log.warning("%s takes no more: %s", site / SITE_LOG, error.strerror)
