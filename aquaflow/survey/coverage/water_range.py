"""How far a camera can map through a water, and how far an eye would see.

The apparent contrast of what lies at the range z is ``C(z) = C(0) exp(-c z)`` along a path on which
the water's own light is as bright as the scene (S. Q. Duntley, Light in the sea, J. Opt. Soc. Am.
53, 214, 1963, Eq. 8; the same law as H. Koschmieder's of 1924 for fog). ``c`` is the fitted
attenuation of the direct light, of the channel that reaches furthest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

TEXTURE_CONTRAST = 0.6
"""Of the ground's own texture, deviation over mean: as the white balance takes it
(mapping/water/white_balance.py)."""
VISIBLE_CONTRAST = 0.05
"""Share of its contrast with which a thing is still seen: the threshold of the meteorological
optical range (WMO-No. 8, Guide to Instruments and Methods of Observation, chapter 9). A black disc
in water is seen to 1 % (Davies-Colley, Limnol. Oceanogr. 33, 1988), half as far again."""


def mapping_range(attenuation: Sequence[float], least_contrast: float) -> float | None:
    """The range beyond which the texture's apparent contrast is below ``least_contrast``, in the
    unit whose inverse ``attenuation`` (of each channel) has; None where no water is to be seen."""
    return _range(attenuation, TEXTURE_CONTRAST, least_contrast)


def visibility(attenuation: Sequence[float]) -> float | None:
    """The range at which contrasts fall to VISIBLE_CONTRAST; in the same unit."""
    return _range(attenuation, 1.0, VISIBLE_CONTRAST)


def _range(attenuation: Sequence[float], inherent: float, apparent: float) -> float | None:
    least = min((float(value) for value in attenuation), default=0.0)
    if not np.isfinite(least) or least <= 0.0:
        return None
    return float(np.log(inherent / apparent)) / least
