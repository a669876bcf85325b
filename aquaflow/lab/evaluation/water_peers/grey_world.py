"""Grey world: the mean of a scene has no colour (Buchsbaum, J. Franklin Institute 310, 1980)."""

from __future__ import annotations

import numpy as np

from aquaflow.lab.evaluation.water_peers.contract import NotRestoredError, Pictures, Ranges

DARKEST_MEAN = 1.0 / 255.0
"""A channel whose mean is below one step of 8 bits holds no colour to balance."""


def restore(
    pictures: Pictures,  # [N, H, W, 3] in [0, 1]
    ranges: Ranges | None,  # [N, H, W], not used
) -> Pictures:
    """Scale every channel of every picture to the picture's mean brightness.

    Raises:
        NotRestoredError: a picture has a channel without light.
    """
    means = pictures.mean(axis=(1, 2), keepdims=True, dtype=np.float64)
    if not (means > DARKEST_MEAN).all():
        raise NotRestoredError("a picture has a channel that is black")
    gains = (means.mean(axis=-1, keepdims=True) / means).astype(np.float32)
    return np.asarray(np.clip(pictures * gains, 0.0, 1.0))
