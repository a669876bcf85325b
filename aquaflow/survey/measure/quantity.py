"""A measured number with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

NORMAL_95 = 1.959964
"""Standard deviations on each side of the mean that hold 95 % of a normal distribution."""


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
        """With a normal error; nothing below ``least`` is possible."""
        half = NORMAL_95 * sigma
        return Quantity(value, sigma, max(least, value - half), value + half, unit)

    def in_words(self) -> str:
        """``12.34 +- 0.05 m``: with the digits that 1 sigma leaves, and 1 sigma."""
        unit = f" {self.unit}" if self.unit else ""
        if not (math.isfinite(self.sigma) and self.sigma > 0.0):
            return f"{self.value:.4g}{unit}"
        decimals = max(0, 1 - math.floor(math.log10(self.sigma)))
        return f"{self.value:.{decimals}f} \u00b1 {self.sigma:.{decimals}f}{unit}"

    def to_json(self) -> dict[str, Any]:
        """``value``, ``sigma``, ``low_95``, ``high_95`` and ``unit``."""
        return {
            "value": self.value, "sigma": self.sigma,
            "low_95": self.low, "high_95": self.high, "unit": self.unit,
        }  # fmt: skip
