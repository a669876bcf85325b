"""Arrays and facts in one file: a zip of arrays (``.npz``, uncompressed, without pickle) that has a
JSON text among them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import DamagedError
from aquaflow.base.storage.archive import read_arrays_of
from aquaflow.base.storage.array_file import Arrays
from aquaflow.base.storage.atomic import atomic_write

FACTS = "facts"
"""Name of the array that holds the facts as JSON."""
MOST_FACTS_BYTES = 1 << 26
"""A camera takes 200 bytes, and no dive has a camera for each of 300,000 views."""


def write_facts_file(
    path: Path,
    facts: dict[str, Any],
    arrays: Arrays,  # by name, of any shape
    allow_nan: bool = True,
) -> None:
    """Write both, whole or not at all.

    Raises:
        InputError: the file cannot be written.
        ValueError: a fact is not finite, and ``allow_nan`` is not set.
    """
    text = json.dumps(facts, allow_nan=allow_nan).encode("utf-8")
    with atomic_write(path) as stream:
        np.savez(stream, allow_pickle=False, **{FACTS: np.frombuffer(text, np.uint8)}, **arrays)


def read_facts_file(path: Path, folders: int = 0) -> tuple[dict[str, Any], Arrays]:
    """What was written; ``folders`` as for :func:`aquaflow.base.errors.regular_file.open_regular`.

    Raises:
        UNREADABLE: one of them, of :mod:`aquaflow.base.storage.archive`.
    """
    arrays = read_arrays_of(path, stored=True, folders=folders)
    text = arrays.pop(FACTS).tobytes()
    if len(text) > MOST_FACTS_BYTES:
        raise DamagedError("its facts are longer than a dive's can be")
    facts: dict[str, Any] = json.loads(text)
    return facts, arrays
