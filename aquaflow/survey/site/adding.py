"""``aquaflow site add``: dives into a site, by one process at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from aquaflow.base.storage.whole_folder import FolderLock
from aquaflow.survey.site.manifest import NAME, SiteDive, add_dives
from aquaflow.survey.site.site_log import say


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
