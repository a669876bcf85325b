"""Contrast that the map loses with range, and that is no water's doing.

From afar a Gaussian's footprint covers more of the scene than the map knows in detail, and poses
and ranges are never exact: the further away a point is, the more it looks like its surroundings.
Water takes contrast too, but draws all colours towards one, its own. Where the two are not kept
apart, attenuations come out too large: by 5 % in red and 29 % in blue on rendered dives in blue
water, by a factor of two on Curasao. What every map loses is given back to the observations before
the fit; what one map loses beyond that is a parameter of the fit (parameters.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from aquaflow.mapping.water.observations import Observations

Array = npt.NDArray[np.float64]

LOSS, LOSS_SIGMA = 0.045, 0.02
"""Optical depth, at the median range, of which contrast is lost as much in every map; mean and
deviation over eight rendered dives (reef, sand, wall and pipe in clear and in blue water)."""


def sharpened(seen: Observations) -> Observations:
    """The observations with the contrast to their surroundings that every map loses."""
    lost = LOSS * seen.z / float(np.median(seen.z))
    return replace(seen, colour=seen.around + (seen.colour - seen.around) * np.exp(lost)[:, None])


def log_attenuation_variance(
    beta_a: Array,  # [3] per map unit
    median_range: float,  # map units
) -> Array:
    """[3, 3] what the loss' deviation adds to the covariance of log beta_a, alike in RGB."""
    share = LOSS_SIGMA / (np.maximum(beta_a, 1e-6) * median_range)
    return np.asarray(np.outer(share, share))
