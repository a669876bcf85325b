"""The dives of a batch as members of a site, which `aquaflow site merge` brings into one frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from aquaflow.base.errors import InputError
from aquaflow.lab.batch.object_store import is_url
from aquaflow.lab.batch.site import DIVES


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
