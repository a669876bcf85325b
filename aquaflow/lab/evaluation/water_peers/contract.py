"""What every published method gets and gives, and the simplest of them, grey world."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import AquaFlowError

Pictures = npt.NDArray[np.float32]
"""[N, H, W, 3] in [0, 1], taken to be proportional to the light, as the map takes them."""
Ranges = npt.NDArray[np.float32]
"""[N, H, W] along the ray, in any unit; 0 or not finite where the range is unknown."""

Method = Callable[[Pictures, Ranges | None], Pictures]
"""Pictures without water, in [0, 1]; raises :class:`NotRestoredError`."""


NAMES = {"sea_thru": "Sea-thru", "udcp": "UDCP", "grey_world": "grey world"}
"""The methods' keys in JSON, and their names in tables."""


class NotRestoredError(AquaFlowError):
    """The method cannot restore these pictures; the message says why."""


# --------------------------------------------------------------------------------------------------
# Grey world: the mean of a scene has no colour (Buchsbaum, J. Franklin Institute 310, 1980).

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
