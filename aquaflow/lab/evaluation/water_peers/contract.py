"""What every published method gets and gives."""

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
