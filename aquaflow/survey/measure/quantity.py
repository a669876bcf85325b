"""A measured number with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from aquaflow.telemetry.world_frame import WorldFrame

NORMAL_95 = 1.959964
"""Standard deviations on each side of the mean that hold 95 % of a normal distribution."""

NO_SIGMA = ".4g"
"""How a number without a sigma is written."""
POSSIBLE = {"": 1.0, "\u00b0": 90.0}
"""What shares and slopes can be at most, by unit; ratios begin at 1."""


@dataclass(frozen=True)
class Quantity:
    """A value, 1 sigma of it, and the interval that holds the truth with 95 %."""

    value: float
    sigma: float
    low: float
    high: float
    """Ends of the 95 % interval; not always as far from the value as each other."""
    unit: str
    """Of all four; empty for shares and ratios."""

    @staticmethod
    def normal(value: float, sigma: float, unit: str, least: float = 0.0) -> Quantity:
        """A quantity with a normal error; nothing below ``least`` is possible."""
        half = NORMAL_95 * sigma
        return Quantity(value, sigma, max(least, value - half), value + half, unit)

    def in_words(self) -> str:
        """``12.34 +- 0.05 m``: with the digits that 1 sigma leaves, and 1 sigma."""
        unit = f" {self.unit}" if self.unit else ""
        digits = self._digits
        if digits == NO_SIGMA:
            return f"{self.value:{digits}}{unit}"
        return f"{self.value:{digits}} \u00b1 {self.sigma:{digits}}{unit}"

    def interval_in_words(self) -> str:
        """``12.24 to 12.44``: the 95 % interval, with the same digits."""
        return f"{self.low:{self._digits}} to {self.high:{self._digits}}"

    @property
    def _digits(self) -> str:
        """How a number is written that has this sigma: with two digits of it."""
        if not (math.isfinite(self.sigma) and self.sigma > 0.0):
            return NO_SIGMA
        return f".{max(0, 1 - math.floor(math.log10(self.sigma)))}f"

    @property
    def says_something(self) -> bool:
        """False where the 95 % interval is wider than the value, and than half of all values that
        shares, ratios and angles can have."""
        return self.high - self.low <= max(self.value, 0.5 * POSSIBLE.get(self.unit, 0.0))

    def to_json(self) -> dict[str, Any]:
        """``value``, ``sigma``, ``low_95``, ``high_95`` and ``unit``."""
        return {
            "value": self.value, "sigma": self.sigma,
            "low_95": self.low, "high_95": self.high, "unit": self.unit,
        }  # fmt: skip


# --------------------------------------------------------------------------------------------------
# The unit that people read lengths and areas in; files and JSON are in metres always.

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


# --------------------------------------------------------------------------------------------------
# The unit of a dive's lengths, and how well scale and vertical are known.


@dataclass(frozen=True)
class Scale:
    """What multiplies all lengths of a dive together, and turns all of it."""

    unit: str
    """Of lengths: ``m`` or ``map units``."""
    sigma: float
    """Relative 1 sigma of the scale. 0 in map units: there is no other ruler that it could differ
    from."""
    tilt_sigma_rad: float
    """1 sigma of the direction of the vertical; 0 where it is a convention and not gravity."""

    @property
    def square_unit(self) -> str:
        """Unit of areas."""
        return "m\u00b2" if self.unit == "m" else f"square {self.unit}"


def scale_of(frame: WorldFrame) -> Scale:
    """Scale of the lengths in n of a sub-map."""
    return Scale(
        frame.unit,
        frame.scale_sigma if frame.metric else 0.0,
        frame.tilt_sigma_rad if frame.level else 0.0,
    )
