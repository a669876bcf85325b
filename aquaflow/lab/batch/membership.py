"""The dives of a batch as members of a site, which `aquaflow site merge` brings into one frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.lab.batch.object_store import is_url
from aquaflow.lab.batch.site import DIVES
from aquaflow.survey.site.adding import add_to_site
from aquaflow.survey.site.manifest import NAME


def make_site(where: str) -> None:
    """Let a folder that is new or empty be a site; any other stays what it is.

    Raises:
        InputError: it cannot be made.
    """
    folder = Path(where)
    if is_url(where) or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        return
    add_to_site(folder, [])


def add_members(where: str, names: Sequence[str]) -> list[str]:
    """Add the dives ``names`` to the site, if it is one; sentences about those that it refuses."""
    site = Path(where)
    if is_url(where) or not (site / NAME).exists() or not names:
        return []
    folders = [site / DIVES / name for name in names]
    try:
        add_to_site(site, folders)
    except InputError:  # then it has added none
        return [sentence for folder in folders if (sentence := _added_alone(site, folder))]
    return []


def _added_alone(site: Path, folder: Path) -> str | None:
    try:
        add_to_site(site, [folder])
    except InputError as error:
        return f"{folder.name} is no member of the site: {error}"
    return None
