"""When each pose of the path was, how deep and which way, and the picture that is nearest to it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]

MOMENT_NUMBERS = 5
"""Of each pose: seconds since the first one, depth, heading, the nearest picture's frame, and that
frame's seconds; what is not known is no number (NaN)."""
HEADING, PICTURE = 2, 3
"""Columns of them."""


def moments(
    t_s: npt.NDArray[np.float64],  # [N] increasing
    depth_m: npt.NDArray[np.float64],  # [N]
    heading_deg: npt.NDArray[np.float64],  # [N] clockwise from what x points to
    index: npt.NDArray[np.int64],  # [N] the frame's, increasing; -1 where it is not known
    kept: Iterable[int],
) -> Float:
    """[N, 5] as ``MOMENT_NUMBERS`` lists them; ``kept``: frames whose picture is there."""
    rows = np.full((len(t_s), MOMENT_NUMBERS), np.nan)
    if not len(t_s):
        return rows.astype(np.float32)
    seconds = t_s - t_s[0]
    rows[:, :3] = np.stack([seconds, depth_m, heading_deg], axis=1)
    pictures, known = np.array(sorted(kept), np.int64), index >= 0
    if len(pictures) and known.any():
        taken_s = np.interp(pictures, index[known], seconds[known])
        right = np.searchsorted(pictures, index).clip(0, len(pictures) - 1)
        left = (right - 1).clip(0)
        nearer = np.abs(pictures[left] - index) <= np.abs(pictures[right] - index)
        nearest = np.where(nearer, left, right)
        rows[known, 3], rows[known, 4] = pictures[nearest][known], taken_s[nearest][known]
    return rows.astype(np.float32)


def unknown(count: int) -> Float:
    """[N, 5] of poses of which nothing else is known."""
    return np.full((count, MOMENT_NUMBERS), np.nan, np.float32)
