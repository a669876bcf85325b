"""``map.aqf``: the exact map; a map that is read renders bit for bit like the one written.

A file of arrays and facts (:mod:`aquaflow.base.storage.archive`), as
:mod:`aquaflow.mapping.state` serialises a map. PLY files show one choice of range or
viewpoint; this file has the water, the light of every view and the decoder itself.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import AquaFlowError, DamagedError, InputError, reason_of
from aquaflow.base.storage.archive import UNREADABLE, read_facts_file, write_facts_file
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import deserialise, serialise
from aquaflow.render.contract import Renderer

SUFFIX = ".aqf"
"""Of a map file."""
KIND = "aquaflow map"
"""The kind of file, stated in its facts."""
FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""


def write_map_file(path: Path, mapper: Mapper, optimiser: bool = False) -> None:
    """Write the map, whole or not at all; with ``optimiser`` it may be optimised further.

    Raises:
        InputError: the file cannot be written.
        ArithmeticError: a number of the map is not finite.
    """
    facts, arrays = serialise(mapper, optimiser)
    bad = [name for name, array in arrays.items() if not _is_finite(array)]
    if bad:
        raise ArithmeticError(f"{bad[0]} of the map is not finite")
    write_facts_file(path, {"kind": KIND, "format": FORMAT, **facts}, arrays)


def _is_finite(
    array: npt.NDArray[Any],  # [...]
) -> bool:
    return array.dtype.kind != "f" or bool(np.isfinite(array).all())


def read_map_file(path: Path, renderer: Renderer) -> Mapper:
    """The map, to be drawn by ``renderer``; its views have no pictures.

    Raises:
        InputError: the file is not there, damaged, not an AquaFlow map, or of a newer AquaFlow.
    """
    try:
        facts, arrays = read_facts_file(path)
        if facts["kind"] != KIND:
            raise DamagedError("it says that it is something else")
    except UNREADABLE as error:
        raise InputError(_unreadable(path, error)) from error
    if facts["format"] != FORMAT:
        raise InputError(
            f"the map {path} has format {facts['format']}, this AquaFlow reads format {FORMAT}; "
            "update AquaFlow"
        )
    try:
        return deserialise(facts, arrays, renderer)
    except (KeyError, ValueError, TypeError, RuntimeError, IndexError, AquaFlowError) as error:
        raise InputError(_unreadable(path, error)) from error


def _unreadable(path: Path, error: Exception) -> str:
    if isinstance(error, OSError):
        return f"cannot read the map {path}: {reason_of(error)}; give a map{SUFFIX}"
    return f"{path} is no whole AquaFlow map ({reason_of(error)}); copy or map it again"
