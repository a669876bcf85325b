"""The water between a browser's eye and the map, as its shader composes it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from aquaflow.base.errors import DamagedError
from aquaflow.dive.medium import lamp_of
from aquaflow.water.mounting import Lamp

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class SeenWater:
    """Image formation of one dive (:class:`aquaflow.dive.medium.Medium`), rates per unit of the
    map."""

    beta: RGB
    """Attenuation."""
    B_inf: RGB
    b: RGB
    B_res: RGB
    d: RGB
    gain: RGB
    """By which colours without water are brighter than the scene's own radiance, before their
    highlights are drawn together."""
    range: float
    """From which most of the map was seen: a browser looks through that much water at most."""
    compression: float
    """Of highlights in the colours without water, see :class:`aquaflow.water.tone.ShownTone`."""
    white: RGB
    """Gain on top of ``gain`` in which a browser shows them: 1 but where another white balance was
    chosen since."""
    shown_compression: float
    """Of the highlights that it shows."""
    lamp: RGB
    """Light from beside the eye (:class:`aquaflow.water.mounting.Lamp`): share, power, range; a
    share of 0 where there is none."""

    def to_json(self) -> dict[str, Any]:
        """The water by the names that the page uses."""
        return asdict(self)


def water_of(medium: dict[str, Any]) -> SeenWater | None:
    """The water in a ``medium.json``; None where it is off.

    Raises:
        DamagedError: a number is missing or none.
    """
    if not medium.get("active"):
        return None
    try:
        veil, restored = medium["backscatter"], medium["restored"]
        tone = float(restored.get("exposure", 1.0)), float(restored.get("highlight_compression", 0))
        # In dives from before 2026-11-27 map_clear.ply has no tone yet, and the choice is a text.
        toned = isinstance(restored.get("white_balance"), dict)
        before, after = (tone, (1.0, tone[1])) if toned else ((1.0, 0.0), tone)
        return seen_water(
            medium["attenuation_per_unit"], veil["B_inf"], veil["b"], veil["B_res"], veil["d"],
            before[0] * np.asarray(restored["gain"], np.float64),
            medium["map_ply_reference_range"],
            before[1], np.full(3, after[0]), after[1], lamp_of(medium),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DamagedError(f"its water is no set of numbers ({error})") from error


def seen_water(
    beta: Any, B_inf: Any, b: Any, B_res: Any, d: Any, gain: Any, range_: Any,
    compression: float = 0.0, white: Any = (1.0, 1.0, 1.0), shown_compression: float = 0.0,
    lamp: Lamp | None = None,
) -> SeenWater:  # fmt: skip
    """The water from anything that is three numbers each.

    Raises:
        ValueError: a number is not finite, or no gain or range.
    """
    triples = (beta, B_inf, b, B_res, d, gain, white)
    parts = [np.asarray(part, np.float64).reshape(3) for part in triples]
    single = (range_, compression, shown_compression)
    if not (np.isfinite(parts).all() and np.isfinite(single).all()):
        raise ValueError("a number of the water is not finite")
    if min(parts[5].min(), parts[6].min(), range_) <= 0 or min(single[1:]) < 0:
        raise ValueError("a number of the water is not positive")
    lit = (0.0, 0.0, 1.0) if lamp is None else (lamp.share, lamp.power, lamp.range)
    of = [(float(part[0]), float(part[1]), float(part[2])) for part in parts]
    return SeenWater(
        of[0], of[1], of[2], of[3], of[4], of[5], float(range_), float(compression), of[6],
        float(shown_compression), lit,
    )  # fmt: skip
