"""``site.json``: the dives of a site, where they lie, and what they were when they were added."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.errors import DamagedError, InputError, printable, reason_of
from aquaflow.base.errors.regular_file import read_regular_json, sha256_regular
from aquaflow.base.storage.atomic import write_json
from aquaflow.dive.dive import Dive
from aquaflow.keyframes.place import NAME as PLACES
from aquaflow.telemetry.metric_file import NAME as METRIC

NAME = "site.json"
"""The file by which a folder is known to be a site."""
FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""
FINGERPRINTED = (PLACES, METRIC, "trajectory.tum", "frames.csv")
"""Files of a dive that a merge reads; one that is not there counts as such."""


@dataclass(frozen=True)
class SiteDive:
    """A dive of a site."""

    name: str
    """The dive folder's name, with a number where two are alike."""
    path: str
    """The dive folder, relative to the site on the same file system."""
    fingerprint: str
    """SHA-256 over places.npz, metric.json, trajectory.tum and frames.csv when added."""

    def folder(self, site: Path) -> Path:
        """The dive folder."""
        return Path(os.path.normpath(os.path.join(site, self.path)))


def fingerprint(dive: Path) -> str:
    """SHA-256 of what a merge reads of the folder ``dive``.

    Raises:
        InputError: a file is there and cannot be read.
    """
    found = hashlib.sha256()
    for name in FINGERPRINTED:
        path = dive / name
        try:
            content = sha256_regular(path) if path.is_file() else ""
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}; check the dive") from error
        found.update(f"{name} {content}\n".encode())
    return found.hexdigest()


STAMPS = "stamps.json"
"""In a site's folder."""
Stamp = list[list[int]]
"""Of each file of ``FINGERPRINTED``: bytes, time of the last change in ns, inode; empty where it is
not there."""


def read_stamps(site: Path) -> dict[str, Stamp]:
    """What the files of a dive's folder looked like when they had the fingerprint; a dive whose
    files still look so is not read again."""
    try:
        return dict(read_regular_json(site / STAMPS))
    except (OSError, ValueError, TypeError):
        return {}


def write_stamps(site: Path, stamps: dict[str, Stamp]) -> None:
    """Write them into the site's folder.

    Raises:
        InputError: the file cannot be written.
    """
    write_json(site / STAMPS, stamps)


def stamp_of(dive: Path) -> Stamp:
    """What the files of the folder ``dive`` look like.

    Raises:
        InputError: a file is there and cannot be looked at.
    """
    found: Stamp = []
    for name in FINGERPRINTED:
        try:
            state = (dive / name).stat()
            found.append([state.st_size, state.st_mtime_ns, state.st_ino])
        except FileNotFoundError:
            found.append([])
        except OSError as error:
            raise InputError(f"cannot read {dive / name}: {error.strerror}; check it") from error
    return found


def check_unchanged(dive: Path, before: str) -> None:
    """Compare the folder ``dive`` with the fingerprint that it was merged with.

    Raises:
        InputError: it is another one now, or cannot be read.
    """
    if fingerprint(dive) != before:
        raise InputError(f"{dive} is not what it was when the site was merged")


def is_site(folder: Path) -> bool:
    """True of a folder with a site's manifest, also a damaged one."""
    return (folder / NAME).is_file()


def read_site(site: Path) -> tuple[SiteDive, ...]:
    """The dives of the site in the folder ``site``, in the order of adding.

    Raises:
        InputError: there is none, it is damaged, or of a newer AquaFlow.
    """
    path = site / NAME
    if not is_site(site):
        raise InputError(f"{site} is no site: {NAME} is missing; make one by `aquaflow site add`")
    try:
        data = read_regular_json(path)
        if data["format"] != FORMAT:
            raise InputError(
                f"{path} is not in format {FORMAT}, which this AquaFlow reads; update AquaFlow"
            )
        dives = tuple(SiteDive(**stated) for stated in data["dives"])
        if len({dive.name for dive in dives}) != len(dives):
            raise DamagedError("two dives have one name")
        if not all(isinstance(part, str) for dive in dives for part in vars(dive).values()):
            raise DamagedError("a dive is described by something other than words")
        return dives
    except (OSError, ValueError, KeyError, TypeError) as error:
        what = reason_of(error)
        raise InputError(f"cannot read {path}: {what}; add the dives to a new site") from error


def add_dives(site: Path, folders: Sequence[Path]) -> list[SiteDive]:
    """Add dive folders to the site, which is made if it is not there; the dives that are new.

    A dive that is in the site already, unchanged, is left as it is; one that was mapped again since
    keeps its name and gets its new fingerprint, and counts as new. Nothing is written if one of the
    folders is no finished dive.

    Raises:
        InputError: a folder is no finished dive, or the site cannot be read or written.
    """
    there = list(read_site(site)) if (site / NAME).exists() else []
    new, stamps = [], read_stamps(site)
    for folder in folders:
        read = Dive(folder)
        read.require()
        _ = read.places  # refuses what cannot be recognised again
        stamp = stamp_of(folder)
        mark = fingerprint(folder)
        stamps[mark] = stamp
        at = next((i for i, dive in enumerate(there) if _same(dive.folder(site), folder)), None)
        if at is None:
            names = {dive.name for dive in there}
            there.append(
                SiteDive(_free(printable(folder.resolve().name), names), _way(site, folder), mark)
            )
            new.append(there[-1])
        elif there[at].fingerprint != mark:
            there[at] = SiteDive(there[at].name, there[at].path, mark)
            new.append(there[at])
    _make(site)
    write_json(site / NAME, {"format": FORMAT, "dives": [vars(dive) for dive in there]})
    marks = {dive.fingerprint for dive in there}
    write_stamps(site, {mark: stamp for mark, stamp in stamps.items() if mark in marks})
    return new


def state_of(site: Path, dive: SiteDive, stamps: dict[str, Stamp] | None = None) -> str:
    """ "as added", "changed" or "missing"; of what is in ``stamps`` nothing is read, what is read
    and is as added gets there.

    Raises:
        InputError: a file of it is there and cannot be read.
    """
    folder = dive.folder(site)
    if not (folder / PLACES).is_file():
        return "missing"
    stamp = stamp_of(folder)
    if stamps is not None and stamps.get(dive.fingerprint) == stamp:
        return "as added"
    if fingerprint(folder) != dive.fingerprint:
        return "changed"
    if stamps is not None:
        stamps[dive.fingerprint] = stamp
    return "as added"


def _same(a: Path, b: Path) -> bool:
    try:
        return a.samefile(b)
    except OSError:  # one of them is gone
        return False


def _free(name: str, taken: set[str]) -> str:
    """``name``, or the first of ``name_2``, ``name_3``, ... that is not taken."""
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free


def _way(site: Path, folder: Path) -> str:
    """Relative, so that site and dives can be moved together, unless only the root is common."""
    base, target = site.resolve(), folder.resolve()
    common = os.path.commonpath([base, target])
    return str(target) if common == base.anchor else os.path.relpath(target, base)


def _make(site: Path) -> None:
    try:
        site.mkdir(parents=True, exist_ok=True)
        occupied = any(site.iterdir()) and not (site / NAME).exists()
    except OSError as error:
        raise InputError(
            f"cannot make the site {site}: {error.strerror}; choose another folder"
        ) from error
    if occupied:
        raise InputError(f"{site} holds files that are no site; choose an empty folder")
