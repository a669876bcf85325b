"""``aquaflow site merge``: the dives of a site recognised in each other and optimised together.

Dives join one after the other. A dive is looked up in all that joined before it, and what that
found is kept on disk, as is the joint graph: a merge that was cut off goes on with the next dive,
and a dive that was added later costs its own look-up, and moves what it touches. Where a dive is
gone or changed, the graph is built anew of the kept links.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cached_property
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import open_to_append
from aquaflow.base.storage.whole_folder import FolderLock
from aquaflow.dive.dive import Dive
from aquaflow.keyframes.place import PlacesFile
from aquaflow.survey.site.joining import join, links_of
from aquaflow.survey.site.joint_graph import JointGraph, read_joint, write_joint
from aquaflow.survey.site.links import LINK, DiveLinks, find_links, read_links, write_links
from aquaflow.survey.site.manifest import (
    NAME,
    SiteDive,
    add_dives,
    read_site,
    read_stamps,
    state_of,
    write_stamps,
)
from aquaflow.survey.site.merged_file import (
    MergedSite,
    read_merged,
    remove_merged,
    write_merged,
)
from aquaflow.survey.site.place_index import PlaceIndex, read_index
from aquaflow.survey.site.placing import place
from aquaflow.survey.site.site_paths import write_paths
from aquaflow.telemetry.world_frame import WorldFrame

Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class Taking:
    """A dive that takes part in a merge; its files are read when they are needed."""

    dive: SiteDive
    folder: Path
    frames: dict[int, WorldFrame]

    @cached_property
    def places(self) -> PlacesFile:
        """Its keyframes."""
        return Dive(self.folder).places


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
        before = _before(site)
        taking, left_out = _taking(site, dives)
        joint = _joint_of(site, taking)
        if taking.keys() - joint.dives:
            _join(site, taking, joint, left_out, progress)
            write_joint(site, joint)
        names = {dive: each.dive.name for dive, each in taking.items()}
        merged = place(joint, names, left_out, before)
        remove_merged(site)
        folders = {each.dive.name: each.folder for each in taking.values()}
        write_paths(site, folders, merged, before)
        write_merged(site, merged)
        say(site, "merged", dives=len(taking), components=len(merged.components))
    finally:
        lock.release()
    return merged


def _before(site: Path) -> MergedSite | None:
    """The last merge; None where there is none that can be read."""
    try:
        return read_merged(site)
    except InputError:
        return None


def _taking(site: Path, dives: Sequence[SiteDive]) -> tuple[dict[str, Taking], dict[str, str]]:
    """The dives that can be merged, by fingerprint, and why the others cannot, by name."""
    taking: dict[str, Taking] = {}
    left_out, stamps = {}, read_stamps(site)
    known = dict(stamps)
    for dive in dives:
        folder = dive.folder(site)
        try:
            state = state_of(site, dive, stamps)
            if state != "as added":
                left_out[dive.name] = _WHY[state]
            elif dive.fingerprint in taking:
                left_out[dive.name] = f"it is a copy of {taking[dive.fingerprint].dive.name}"
            else:
                taking[dive.fingerprint] = Taking(dive, folder, dict(Dive(folder).metric_frames))
        except InputError as error:
            left_out[dive.name] = str(error)
    if stamps != known:
        write_stamps(site, stamps)
    _require(site, taking, left_out)
    return taking, left_out


def _joint_of(site: Path, taking: Mapping[str, Taking]) -> JointGraph:
    """As the last merge left it; an empty one where there is none of these dives."""
    joint = read_joint(site, {dive: each.frames for dive, each in taking.items()})
    return joint or JointGraph()


def _require(site: Path, taking: Mapping[str, Taking], left_out: Mapping[str, str]) -> None:
    if not taking:
        why = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise InputError(f"{site} has no dive that can be merged ({why or 'it is empty'})")


_NO_LINKS = DiveLinks((), np.zeros(0, LINK))
_WHY = {
    "changed": "it changed since it was added; add it again to use it as it is now",
    "missing": "its folder or its places.npz is gone; put it back, or map the dive again",
}


def _join(
    site: Path,
    taking: dict[str, Taking],
    joint: JointGraph,
    left_out: dict[str, str],
    progress: Progress,
) -> None:
    """Add the dives that are not in the joint graph yet: those that were looked up before first."""
    index = _index(site, taking, left_out)
    for dive, known in _in_order(site, taking, joint):
        links = known or _NO_LINKS
        others, among = _left(site, joint.dives, dive, known)
        if among or known is None:
            links += _look_up(site, taking, index, dive, among, progress)
            write_links(site, dive, links)
        joint.add(dive, taking[dive].places, taking[dive].frames)
        rows = [links_of(joint, dive, links), *(links_of(joint, *each) for each in others)]
        join(joint, np.concatenate(rows))


def _in_order(
    site: Path, taking: Mapping[str, Taking], joint: JointGraph
) -> list[tuple[str, DiveLinks | None]]:
    """The dives that join, and what looking them up found before; those where it is known first."""
    new = [(dive, read_links(site, dive)) for dive in taking if dive not in joint.dives]
    return sorted(new, key=lambda each: each[1] is None)


def _left(
    site: Path, dives: Sequence[str], dive: str, known: DiveLinks | None
) -> tuple[list[tuple[str, DiveLinks]], list[str]]:
    """Of ``dives``: what those found that were looked for in ``dive``, and those that neither it
    was looked for in nor were looked for in it."""
    if known is None:
        return [], list(dives)
    others = _links_from(site, dives, dive, known)
    covered = {*known.among, *(each for each, _ in others)}
    return others, [each for each in dives if each not in covered]


def _index(site: Path, taking: dict[str, Taking], left_out: dict[str, str]) -> PlaceIndex:
    """The index of all dives; one that does not fit into it is left out."""
    index = read_index(site, {dive.fingerprint for dive in read_site(site)})
    missing = [dive for dive in taking if dive not in index.dives]
    for dive in missing:
        try:
            index.add(dive, taking[dive].places)
        except InputError as error:
            left_out[taking.pop(dive).dive.name] = str(error)
    _require(site, taking, left_out)
    if missing:
        index.write(site)
    return index


def _links_from(
    site: Path, dives: Sequence[str], dive: str, links: DiveLinks
) -> list[tuple[str, DiveLinks]]:
    """Of those of ``dives`` that ``dive`` was not looked for in, but that were looked for in it:
    what that found."""
    found = []
    for other in dives:
        theirs = None if other in links.among else read_links(site, other)
        if theirs is not None and dive in theirs.among:
            rows = theirs.rows[theirs.rows["dive"] == theirs.among.index(dive)]
            found.append((other, DiveLinks(theirs.among, rows)))
    return found


def _look_up(
    site: Path,
    taking: Mapping[str, Taking],
    index: PlaceIndex,
    dive: str,
    among: Sequence[str],
    progress: Progress,
) -> DiveLinks:
    name = taking[dive].dive.name

    def advance(done: int, total: int) -> None:
        progress(name, done, total)

    links = find_links(index, lambda each: taking[each].places, dive, among, advance)
    say(site, "looked_up", dive=name, among=len(among), links=len(links.rows))
    return links


# --------------------------------------------------------------------------------------------------
# The look-ups apart from the rest: any process may do each, in any order, and a merge finds on disk
# what they found.


@dataclass(frozen=True)
class LookUp:
    """A dive that is to be looked for in those that join before it."""

    name: str
    """Of the dive."""
    dive: str
    """Its fingerprint."""
    among: tuple[str, ...]
    """Those of the others."""
    keyframes: int
    """Of the dive; each is compared with no more keyframes, however many the others are."""


def look_ups(site: Path) -> list[LookUp]:
    """Those that :func:`merge` would do now; after this, the index holds every dive.

    Raises:
        InputError: as :func:`merge`.
    """
    dives = read_site(site)
    lock = FolderLock(site)
    try:
        taking, left_out = _taking(site, dives)
        joint = _joint_of(site, taking)
        _index(site, taking, left_out)
        before, found = list(joint.dives), list[LookUp]()
        for dive, known in _in_order(site, taking, joint):
            _, among = _left(site, before, dive, known)
            if among:
                mine = taking[dive]
                found.append(LookUp(mine.dive.name, dive, tuple(among), len(mine.places.places)))
            elif known is None:
                write_links(site, dive, _NO_LINKS)
            before.append(dive)
    finally:
        lock.release()
    return found


def look_up(site: str, wanted: Sequence[tuple[str, Sequence[str]]]) -> None:
    """Do some of :func:`look_ups`, of the site in the folder ``site``: each a dive and those that
    it is looked for in, by their fingerprints.

    Raises:
        InputError: a file is damaged, or cannot be written.
    """
    where = Path(site)
    taking = {each.fingerprint: Taking(each, each.folder(where), {}) for each in read_site(where)}
    index = read_index(where, taking)
    for dive, among in wanted:
        known = read_links(where, dive) or _NO_LINKS
        links = known + _look_up(where, taking, index, dive, among, lambda *_: None)
        write_links(where, dive, links)


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
