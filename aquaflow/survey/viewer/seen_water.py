"""The water between a browser's eye and the map, as its shader composes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from aquaflow.base.errors import DamagedError

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class SeenWater:
    """Image formation of one dive (paper, Eq. 12 and 15), rates per unit of the map."""

    beta: RGB
    """Attenuation."""
    B_inf: RGB
    b: RGB
    B_res: RGB
    d: RGB
    gain: RGB
    """By which colours without water are brighter than the scene's own radiance."""
    range: float
    """From which most of the map was seen: a browser looks through that much water at most."""

    def to_json(self) -> dict[str, Any]:
        """The water by the names that the page uses."""
        return {
            "beta": self.beta, "B_inf": self.B_inf, "b": self.b, "B_res": self.B_res, "d": self.d,
            "gain": self.gain, "range": self.range,
        }  # fmt: skip


def water_of(medium: dict[str, Any]) -> SeenWater | None:
    """The water in a ``medium.json``; None where it is off.

    Raises:
        DamagedError: a number is missing or none.
    """
    if not medium.get("active"):
        return None
    try:
        veil = medium["backscatter"]
        return seen_water(
            medium["attenuation_per_unit"], veil["B_inf"], veil["b"], veil["B_res"], veil["d"],
            medium["restored"]["gain"], medium["map_ply_reference_range"],
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedError(f"its water is no set of numbers ({error})") from error


def seen_water(
    beta: Any, B_inf: Any, b: Any, B_res: Any, d: Any, gain: Any, range_: Any
) -> SeenWater:
    """The water from anything that is three numbers each.

    Raises:
        ValueError: a number is not finite, or no gain or range.
    """
    parts = [np.asarray(part, np.float64).reshape(3) for part in (beta, B_inf, b, B_res, d, gain)]
    if not (np.isfinite(parts).all() and np.isfinite(range_) and parts[5].min() > 0 < range_):
        raise ValueError("a number of the water is not finite or not positive")
    of = [(float(part[0]), float(part[1]), float(part[2])) for part in parts]
    return SeenWater(of[0], of[1], of[2], of[3], of[4], of[5], float(range_))
