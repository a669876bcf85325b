"""Where a batch writes: a folder, or an address in an object store. A dive appears in it whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular
from aquaflow.lab.batch.job import BatchJob, BatchOutcome
from aquaflow.lab.batch.manifest import MANIFEST, earlier_outcome, files_of, read_manifest
from aquaflow.lab.batch.object_store import ObjectStore, is_url

DIVES = "dives"


class DiveStore(Protocol):
    """Takes finished dives."""

    def finished_outcome(self, job: BatchJob) -> BatchOutcome | None:
        """What came of ``job`` if its dive is there already, else None.

        Raises:
            InputError: there is a dive of this name of another recording or other settings.
        """
        ...

    def work_parent(self, job: BatchJob) -> Path:
        """The local folder in which the dive's working folder is made."""
        ...

    def publish(self, dive: Path, job: BatchJob) -> None:
        """Let the finished local folder ``dive`` be a dive of the site, whole or not at all.

        Raises:
            InputError, OSError: there is no room for it.
        """
        ...


def open_site(where: str) -> DiveStore:
    """The site at a path or URL; makes nothing."""
    return StoreSite(where) if is_url(where) else FolderSite(Path(where))


class FolderSite:
    """A site on a disk, which on a cluster every node sees under the same path."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def finished_outcome(self, job: BatchJob) -> BatchOutcome | None:
        dive = self.path / DIVES / job.name
        if not dive.exists():
            return None
        try:
            text = read_regular(dive / MANIFEST)
        except OSError as error:
            raise InputError(
                f"{dive} is not of a batch; remove it, or give another --out"
            ) from error
        return earlier_outcome(read_manifest(text, str(dive)), job, str(dive))

    def work_parent(self, job: BatchJob) -> Path:
        return self.path / DIVES

    def publish(self, dive: Path, job: BatchJob) -> None:
        target = self.path / DIVES / job.name
        try:
            dive.rename(target)
        except OSError:
            # Another machine, thought dead, was first: its dive is as good.
            if not (target / MANIFEST).exists():
                raise


class StoreSite:
    """A site in an object store, where nothing can be renamed: the manifest comes last."""

    def __init__(self, url: str) -> None:
        self.store = ObjectStore(url)

    def finished_outcome(self, job: BatchJob) -> BatchOutcome | None:
        where = f"{self.store.url}/{DIVES}/{job.name}"
        text = self.store.read(f"{DIVES}/{job.name}/{MANIFEST}")
        return None if text is None else earlier_outcome(read_manifest(text, where), job, where)

    def work_parent(self, job: BatchJob) -> Path:
        return Path(job.cache)

    def publish(self, dive: Path, job: BatchJob) -> None:
        if self.finished_outcome(job) is not None:  # another machine, thought dead, was first
            return
        to = f"{DIVES}/{job.name}"
        self.store.remove(to)  # of an attempt that was cut off
        for path in sorted(files_of(dive), key=lambda path: path.name == MANIFEST):
            self.store.put(path, f"{to}/{path.relative_to(dive).as_posix()}")


# --------------------------------------------------------------------------------------------------
# The dives of a batch as members of a site, which `aquaflow site merge` brings into one frame.


class Sites(NamedTuple):
    """What a batch asks of sites, which are not the lab's."""

    is_site: Callable[[Path], bool]
    """True of the folder of a site."""
    add: Callable[[Path, Sequence[Path]], object]
    """Add dives to a site, and make the site where there is none; raises InputError, and then has
    added none."""


def make_site(where: str, sites: Sites) -> None:
    """Let a folder that is new or empty be a site; any other stays what it is.

    Raises:
        InputError: it cannot be made.
    """
    folder = Path(where)
    if is_url(where) or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        return
    sites.add(folder, [])


def add_members(where: str, names: Sequence[str], sites: Sites) -> list[str]:
    """Add the dives ``names`` to the site, if it is one; sentences about those that it refuses."""
    site = Path(where)
    if is_url(where) or not sites.is_site(site) or not names:
        return []
    folders = [site / DIVES / name for name in names]
    try:
        sites.add(site, folders)
    except InputError:
        return [sentence for folder in folders if (sentence := _added_alone(site, folder, sites))]
    return []


def _added_alone(site: Path, folder: Path, sites: Sites) -> str | None:
    try:
        sites.add(site, [folder])
    except InputError as error:
        return f"{folder.name} is no member of the site: {error}"
    return None
