"""The map's ranges of a dive's held-out views."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from aquaflow.evaluation.water_peers.contract import Ranges

DAMAGE = (
    *(OSError, EOFError, ValueError, TypeError, KeyError, IndexError),
    *(BadZipFile, NotImplementedError, RuntimeError, zlib.error),
)
"""What numpy and zipfile raise for a file that is not the one that was written."""


def held_out_ranges(dive: Path, indices: Sequence[int], size: tuple[int, int]) -> Ranges | None:
    """[N, H, W] in map units, 0 where the map is not solid; None if any is missing or damaged.

    ``size`` is the height and width of the held-out pictures.
    """
    found = []
    for index in indices:
        try:
            with (dive / "heldout" / f"{index:06d}_range.npz").open("rb") as stream:
                z = np.asarray(np.load(stream)["z"], np.float32)
        except DAMAGE:
            return None
        if z.shape != size:
            return None
        found.append(z)
    return np.stack(found)
