"""How well the water was recovered: the dive's ``medium.json`` against a synthetic dive's truth.

The water is ``I = J exp(-beta_a z) + B_inf (1 - exp(-b z)) + B_res exp(-d z)`` with the range z.
A dive of unknown scale has its rates per map unit; the trajectory's alignment (truth = scale x map)
takes them to rates per metre.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.lab.synthetic.water import WATER_TYPES, Medium

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


def read_recovered(path: Path, metres_per_unit: float) -> tuple[Medium, bool]:
    """A dive's ``medium.json`` with rates per metre, and whether the medium was active.

    Args:
        path: the file; ``attenuation_unit`` names the unit of all its rates.
        metres_per_unit: scale of the alignment; not used if the dive's rates are per metre already.

    Raises:
        InputError: the file is not a dive's medium.
    """
    try:
        data = read_regular_json(path)
        if not data["active"]:
            return WATER_TYPES["clear"], False
        per_metre = 1.0 if data["attenuation_unit"] == "1/m" else 1.0 / metres_per_unit
        scatter = data["backscatter"]
        medium = Medium(
            beta_a=_rgb(data["attenuation_per_unit"], per_metre),
            b=_rgb(scatter["b"], per_metre),
            B_inf=_rgb(scatter["B_inf"]),
            B_res=_rgb(scatter["B_res"]),
            d=_rgb(scatter["d"], per_metre),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        what = f"key {error} is missing" if isinstance(error, KeyError) else reason_of(error)
        raise InputError(f"cannot read the medium {path}: {what}; map the dive again") from error
    return medium, True


def _rgb(value: object, factor: float = 1.0) -> tuple[float, float, float]:
    """Three finite, non-negative numbers times ``factor``."""
    channels = np.asarray(value, dtype=np.float64)
    if channels.shape != (3,) or not np.isfinite(channels).all() or (channels < 0.0).any():
        raise DamagedError("a colour is not three numbers of at least 0")
    red, green, blue = (channels * factor).tolist()
    return red, green, blue
