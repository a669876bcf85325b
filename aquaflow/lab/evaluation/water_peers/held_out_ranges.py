"""The map's ranges of a dive's held-out views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.lab.evaluation.held_out import read_range
from aquaflow.lab.evaluation.water_peers.contract import Ranges


def held_out_ranges(dive: Path, indices: Sequence[int], size: tuple[int, int]) -> Ranges | None:
    """[N, H, W] in the dive's unit, 0 where the map is not solid; None if any is missing or
    damaged.

    ``size`` is the height and width of the held-out pictures.
    """
    found = []
    for index in indices:
        try:
            z = read_range(dive, index)
        except InputError:
            return None
        if z is None or z.shape != size:
            return None
        found.append(z)
    return np.stack(found)
