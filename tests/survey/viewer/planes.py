"""A flat map that is known exactly: a floor of Gaussians at one depth."""

from __future__ import annotations

import numpy as np

from aquaflow.survey.viewer.splats import ViewerSplats, splats

DEPTH = 5.0
SIDE = 4.0


def floor(
    step: float = 0.05, opacity: float = 0.9, rgb: tuple[float, float, float] = (0.5, 0.5, 0.5)
) -> ViewerSplats:
    """Gaussians each ``step`` of the square |x|, |y| <= 4 at z = 5, hardly thick."""
    at = np.arange(-SIDE, SIDE + step / 2, step)
    x, y = (each.ravel() for each in np.meshgrid(at, at))
    count = len(x)
    return splats(
        np.stack([x, y, np.full(count, DEPTH)], axis=1).astype(np.float32),
        np.tile(np.array([[1.0, 0.0, 0.0, 0.0]], np.float32), (count, 1)),
        np.tile(np.array([[step, step, 0.002]], np.float32), (count, 1)),
        np.full(count, opacity, np.float32),
        np.tile(np.array([rgb], np.float32), (count, 1)),
        count,
    )
