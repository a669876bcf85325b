"""The plane of a plan view: what points to the right and up on the page."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

LEVEL = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
"""Rows: what points right and up on the page, in n, which is north-east-down."""
FORWARD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FACING = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The same in a map that is not level, whose axes are the first picture's: right, down, ahead."""


def page_axes(
    frame: WorldFrame,
    path: Array,  # [N, 3] camera centres, n
) -> Array:
    """[2, 3] the directions of n that are right and up on the page: LEVEL, FORWARD or FACING."""
    if frame.level:
        return LEVEL
    spread = np.ptp(path, axis=0)
    return FORWARD if spread[2] >= spread[1] else FACING


def page_rotation(
    axes: Array,  # [2, 3] as from page_axes
) -> Array:
    """R [3, 3] from n to the page: right, up, and towards who looks at it."""
    return np.vstack([axes, np.cross(axes[0], axes[1])])


def names_of(frame: WorldFrame, axes: Array) -> tuple[str, str, str]:  # [2, 3] of page_axes
    """From where the page is seen, and what right and up on it are, in words."""
    if axes is FACING:
        return "as in the first picture", "right", "up"
    if axes is FORWARD:
        return "from above the first picture", "right of it", "ahead of it"
    north = frame.north
    return "from above", "east" if north.endswith("north") else f"right of the {north}", north
