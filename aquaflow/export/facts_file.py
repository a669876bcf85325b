"""Arrays and facts in one file: a zip of arrays (``.npz``, uncompressed, without pickle) that has a
JSON text among them.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.export.atomic import atomic_write
from aquaflow.plain_arrays import Arrays

FACTS = "facts"
UNREADABLE = (OSError, zipfile.BadZipFile, ValueError, KeyError, TypeError, EOFError)
"""What :func:`read_facts_file` raises where a file is not there, damaged, or none of ours."""


def write_facts_file(
    path: Path, facts: dict[str, Any], arrays: Arrays, allow_nan: bool = True
) -> None:
    """Write both, whole or not at all.

    Raises:
        InputError: the file cannot be written.
        ValueError: a fact is not finite, and ``allow_nan`` is not set.
    """
    text = json.dumps(facts, allow_nan=allow_nan).encode("utf-8")
    with atomic_write(path) as stream:
        np.savez(stream, allow_pickle=False, **{FACTS: np.frombuffer(text, np.uint8)}, **arrays)


def read_facts_file(path: Path) -> tuple[dict[str, Any], Arrays]:
    """What was written.

    Raises:
        UNREADABLE: one of them.
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    facts: dict[str, Any] = json.loads(arrays.pop(FACTS).tobytes())
    return facts, arrays
