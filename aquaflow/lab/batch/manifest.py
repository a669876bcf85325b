"""``manifest.json`` of a dive of a batch: which files it has, and of which job it is.

It is written last: a dive with a manifest is whole.
"""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any

from aquaflow import __version__
from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import sha256_regular
from aquaflow.base.storage.atomic import is_part, write_json
from aquaflow.lab.batch.job import BatchJob, BatchOutcome

MANIFEST = "manifest.json"


def write_manifest(dive: Path, job: BatchJob, outcome: BatchOutcome) -> None:
    """Write the manifest of the finished ``dive``.

    Raises:
        InputError: it cannot be written.
    """
    files = [path for path in files_of(dive) if path.name != MANIFEST]
    listed = {
        path.relative_to(dive).as_posix(): {
            "bytes": path.stat().st_size,
            "sha256": sha256_regular(path),
        }
        for path in files
    }
    write_json(
        dive / MANIFEST,
        {
            "dive": job.name,
            "job": job.digest(),
            "version": __version__,
            "outcome": outcome.to_json(),
            "files": listed,
        },
    )


def files_of(dive: Path) -> list[Path]:
    """The regular files of a dive; where others left a link, it is none, and not followed."""
    return sorted(
        Path(folder) / name
        for folder, _, names in os.walk(dive)
        for name in names
        if stat.S_ISREG((Path(folder) / name).lstat().st_mode) and not is_part(Path(name))
    )


def earlier_outcome(manifest: dict[str, Any], job: BatchJob, where: str) -> BatchOutcome:
    """What came of ``job`` when the dive with this manifest was written.

    Raises:
        InputError: the dive is of another recording or other settings, or the manifest is none.
    """
    try:
        same = manifest["job"] == job.digest()
        found = BatchOutcome.of_json(manifest["outcome"] | {"earlier": True})
    except (KeyError, TypeError) as error:
        raise InputError(f"{where}/{MANIFEST} is damaged; remove that dive") from error
    if not same:
        raise InputError(
            f"{where} was made of another recording or with other settings; remove it, or give "
            "another --out"
        )
    return found


def read_manifest(text: bytes, where: str) -> dict[str, Any]:
    """The manifest in ``text``.

    Raises:
        InputError: it is none.
    """
    try:
        content = json.loads(text)
    except ValueError as error:
        raise InputError(f"{where}/{MANIFEST} is damaged; remove that dive") from error
    return content if isinstance(content, dict) else {}
