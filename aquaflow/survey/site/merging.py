"""``aquaflow site merge``: the dives of a site recognised in each other and optimised together.

Links of a pair of dives are kept on disk as soon as they are found: a merge that was cut off goes
on with the next pair, and a dive added later is compared with the others alone. The rest takes
seconds, is done anew each time, and gives the same bytes for the same dives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.storage.folder_lock import FolderLock
from aquaflow.dive.dive import Dive
from aquaflow.keyframes.places_file import PlacesFile
from aquaflow.survey.site.joining import join
from aquaflow.survey.site.joint_graph import JointGraph, by_knowledge, sub_maps_of
from aquaflow.survey.site.link_files import link_file, read_links, write_links
from aquaflow.survey.site.links import CrossLink, find_links
from aquaflow.survey.site.manifest import SiteDive, read_site, state_of
from aquaflow.survey.site.merged_file import MergedSite, remove_merged, write_merged
from aquaflow.survey.site.placing import placed
from aquaflow.survey.site.site_log import say
from aquaflow.survey.site.site_paths import write_paths
from aquaflow.telemetry.metric_frame import MetricFrame

Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class Taking:
    """A dive that takes part in a merge."""

    dive: SiteDive
    folder: Path
    places: PlacesFile
    frames: dict[int, MetricFrame]


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
        merged = _merged(taking, left_out, found)
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


def _merged(
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
    return placed(joint, [each.dive for each in taking], left_out, judged)
