"""How well the water was recovered: the dive's ``medium.json`` against a synthetic dive's truth.

The water is ``I = J exp(-beta_a z) + B_inf (1 - exp(-b z)) + B_res exp(-d z)`` with the range z.
A dive of unknown scale has its rates per map unit; the trajectory's alignment (truth = scale x map)
takes them to rates per metre.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from aquaflow.dive.dive import Dive
from aquaflow.dive.medium import Medium, Rgb
from aquaflow.lab.synthetic.water import WATER_TYPES

BACKSCATTER_SPAN_M = (0.5, 8.0)
"""Ranges over which the two backscatter curves are compared: a hand's width to turbid distance."""

BACKSCATTER_SAMPLES = 64
"""Ranges, evenly spaced over the span, at which the curves are compared."""


@dataclass(frozen=True)
class MediumError:
    """Recovered water against true water."""

    attenuation_per_m: list[float]
    """[3] recovered, per metre of the truth."""
    true_attenuation_per_m: list[float]
    attenuation_ratio: list[float | None]
    """[3] recovered over true; null where the truth is zero."""
    backscatter_rmse: float
    """Between the curves B(z), in units of image brightness, over ``backscatter_span_m``.

    The curves are compared, not their parameters: b and d of two curves that agree can differ."""
    backscatter_span_m: tuple[float, float]
    B_inf_error: list[float]
    """[3] recovered minus true."""
    active: bool
    """False if the dive found the water clear and modelled none."""

    def to_json(self) -> dict[str, Any]:
        """As plain values with the names above."""
        return asdict(self)


def compare_medium(recovered: Medium, truth: Medium, *, active: bool) -> MediumError:
    """Compare two waters whose rates are per metre."""
    ratio = [
        found / true if true > 0.0 else None
        for found, true in zip(recovered.beta_a, truth.beta_a, strict=True)
    ]
    z = np.linspace(*BACKSCATTER_SPAN_M, BACKSCATTER_SAMPLES)
    difference = recovered.backscatter(z) - truth.backscatter(z)
    return MediumError(
        attenuation_per_m=list(recovered.beta_a),
        true_attenuation_per_m=list(truth.beta_a),
        attenuation_ratio=ratio,
        backscatter_rmse=float(np.sqrt(np.mean(difference**2))),
        backscatter_span_m=BACKSCATTER_SPAN_M,
        B_inf_error=(np.array(recovered.B_inf) - np.array(truth.B_inf)).tolist(),
        active=active,
    )


def recovered_water(dive: Dive, metres_per_unit: float) -> tuple[Medium, bool]:
    """The water of a dive with rates per metre, and whether one was modelled; without, clear water.

    Args:
        dive: ``attenuation_unit`` of its medium.json names the unit of all its rates.
        metres_per_unit: scale of the alignment; not used if the dive's rates are per metre already.

    Raises:
        InputError: the file is not a dive's medium.
    """
    found = dive.medium
    if found is None:
        return WATER_TYPES["clear"], False
    if dive.medium_facts.get("attenuation_unit") == "1/m":
        return found, True
    per_metre = 1.0 / metres_per_unit
    rates = {name: _times(getattr(found, name), per_metre) for name in ("beta_a", "b", "d")}
    return replace(found, **rates), True


def _times(colour: Rgb, factor: float) -> Rgb:
    red, green, blue = (factor * each for each in colour)
    return red, green, blue
