"""How far one sees in the water of a dive, from its attenuation."""

from __future__ import annotations

import math
from collections.abc import Sequence

from aquaflow.survey.coverage.water_range import VISIBLE_CONTRAST
from aquaflow.survey.measure.quantity import NORMAL_95, Quantity
from aquaflow.survey.measure.scale import Scale

DEFINITION = (
    "range at which contrasts of the scene fall to 5 %: ln(20) / attenuation (Koschmieder's law), "
    "in the colour that reaches farthest; for the light there was and this camera's colours"
)


def visibility(
    attenuation: Sequence[float],
    relative_sigma: Sequence[float] | None,
    scale: Scale,
) -> Quantity | None:
    """The visibility range; None where attenuation is no measurement.

    Args:
        attenuation: of red, green and blue, per unit of length of ``scale``.
        relative_sigma: 1 sigma of each over its value, with the scale as exact; None: unknown, as
            where the ranges that were seen never allowed a fit.
    """
    if relative_sigma is None:
        return None
    known = [
        (rate, sigma)
        for rate, sigma in zip(attenuation, relative_sigma, strict=True)
        if rate > 0.0 and math.isfinite(rate) and math.isfinite(sigma)
    ]
    if not known:
        return None
    rate, relative = min(known)
    relative = math.hypot(relative, scale.sigma)
    value = -math.log(VISIBLE_CONTRAST) / rate
    # A rate's error is one of its logarithm: twice the rate is as likely as half of it.
    factor = math.exp(NORMAL_95 * relative)
    return Quantity(value, value * relative, value / factor, value * factor, scale.unit)
