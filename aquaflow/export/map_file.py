"""``map.aqf``: the exact map. What comes back renders bit for bit as what was written.

A zip of arrays (``.npz``, uncompressed, without pickle) and ``facts``, a JSON text in it, as
:mod:`aquaflow.mapping.map_state` takes a map apart. PLY files, beside it, show one choice of range
or viewpoint; this has the water, the light of every view and the decoder themselves.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np

from aquaflow.errors import AquaFlowError, InputError
from aquaflow.export.atomic import atomic_write
from aquaflow.mapping.map_state import put_together, take_apart
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.contract import Renderer

SUFFIX = ".aqf"
KIND = "aquaflow map"
FORMAT = 1
FACTS = "facts"


def write_map_file(path: Path, mapper: Mapper, optimiser: bool = False) -> None:
    """Write the map, whole or not at all; with ``optimiser`` it may be optimised further.

    Raises:
        InputError: the file cannot be written.
    """
    facts, arrays = take_apart(mapper, optimiser)
    text = json.dumps({"kind": KIND, "format": FORMAT, **facts}).encode("utf-8")
    with atomic_write(path) as stream:
        np.savez(stream, **{FACTS: np.frombuffer(text, np.uint8)}, **arrays)  # type: ignore[arg-type]


def read_map_file(path: Path, renderer: Renderer) -> Mapper:
    """The map, to be drawn by ``renderer``; its views have no pictures.

    Raises:
        InputError: the file is not there, damaged, none of ours, or of a newer AquaFlow.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise InputError(f"the map {path} is damaged in {damaged}; copy it or map again")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        facts = json.loads(arrays.pop(FACTS).tobytes())
        if facts["kind"] != KIND:
            raise ValueError(f"it says that it is '{facts['kind']}'")
    except (OSError, zipfile.BadZipFile, ValueError, KeyError, TypeError, EOFError) as error:
        raise InputError(_unreadable(path, error)) from error
    if facts["format"] != FORMAT:
        raise InputError(
            f"the map {path} has format {facts['format']}, this AquaFlow reads format {FORMAT}; "
            "update AquaFlow"
        )
    try:
        return put_together(facts, arrays, renderer)
    except (KeyError, ValueError, TypeError, RuntimeError, IndexError, AquaFlowError) as error:
        raise InputError(_unreadable(path, error)) from error


def _unreadable(path: Path, error: Exception) -> str:
    if isinstance(error, OSError):
        return f"cannot read the map {path}: {error.strerror or error}; give a map{SUFFIX}"
    said = str(error).strip().splitlines()
    return f"{path} is no whole AquaFlow map ({said[0] if said else 'empty'}); copy or map it again"
