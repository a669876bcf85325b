"""The side of a net cage: twine of equal meshes with open water behind, on a frame of ropes."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.objects import Solid

__all__ = ["BEHIND_M", "netting"]

Array: TypeAlias = npt.NDArray[np.float64]

BEHIND_M = 40.0
"""To the next solid thing behind the net: farther than anything is seen."""
MESHES_M = (0.03, 0.05)
"""Range of a mesh's edge; salmon cages have 20 to 30 mm, predator nets more."""
TWINE_SHARE = 0.11
"""Thickness of the twine over the edge of a mesh, new and a little fouled."""
MARGIN_M = 8.0
"""Around the vehicle's way: what an oblique view reaches."""
TWINE, FOULING = (0.52, 0.55, 0.50), (0.34, 0.30, 0.16)
"""Albedo, RGB."""


def netting(
    low: Array,  # [2] m
    high: Array,  # [2] m
    rng: np.random.Generator,
) -> Solid:
    """The net in the plane z = 0, round the way from ``low`` to ``high``, a little askew."""
    mesh = float(rng.uniform(*MESHES_M))
    turn = float(rng.uniform(-0.1, 0.1))
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    half = 0.5 * (high - low) + MARGIN_M
    centre = np.array([*(0.5 * (low + high)), 0.0])
    size = (float(half[0]), float(half[1]), 0.01)
    return Solid(
        "net", centre, R, size, TWINE, FOULING, 0.35, mesh_m=mesh, twine_m=TWINE_SHARE * mesh
    )
