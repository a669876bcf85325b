"""The unit that people read lengths and areas in; files and JSON are in metres always."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from aquaflow.survey.measure.quantity import Quantity

LengthUnit = Literal["metres", "feet"]

FOOT_M = 0.3048
"""The international foot, m, exactly (NIST Handbook 44, appendix C)."""
FEET = {"m": ("ft", FOOT_M), "m\u00b2": ("ft\u00b2", FOOT_M**2)}
"""Unit, and how much of the metric one it is."""


def as_read(quantity: Quantity, unit: LengthUnit) -> Quantity:
    """The same in ``unit``; what is no metric length or area, as angles and map units, stays."""
    if unit == "metres" or quantity.unit not in FEET:
        return quantity
    name, size = FEET[quantity.unit]
    value, sigma, low, high = (
        each / size for each in (quantity.value, quantity.sigma, quantity.low, quantity.high)
    )
    return replace(quantity, value=value, sigma=sigma, low=low, high=high, unit=name)
