"""The water between scene and camera: the paper's image formation and a table of waters.

I = J exp(-beta_a z) + B_inf (1 - exp(-b z)) + B_res exp(-d z), with z the range along the ray.

The attenuations follow Jerlov's types. Diffuse attenuation K_d per metre for (R, G, B) is -ln of
the transmission per metre tabulated by Li, Anwar and Porikli, "Underwater scene prior inspired deep
underwater image and video enhancement", Pattern Recognition 98 (2020), Table 1 (quoted from memory:
check them against the table before citing them). What a camera sees
fades with the beam attenuation, which is larger because scattered light leaves the beam too; we
take 2.2 K_d, a factor in the range of 2 to 4 that such waters show. B_inf, b, B_res and d are
chosen: the colour of the open water follows the channel that travels furthest.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import yaml

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.dive.medium import Medium, Rgb
from aquaflow.lab.synthetic.config import WaterType

__all__ = ["WATER_TYPES", "Medium", "Rgb", "load_medium", "save_medium"]

BEAM_OVER_DIFFUSE = 2.2
"""Beam attenuation over diffuse attenuation (see the module's text)."""


def _jerlov(transmission: Rgb, B_inf: Rgb, b_over_beta: float, B_res: Rgb) -> Medium:
    beta = [-BEAM_OVER_DIFFUSE * float(np.log(t)) for t in transmission]
    # Backscatter saturates at a rate closer to the clearest channel's in every channel (measured
    # as wideband coefficients by Akkaynak and Treibitz 2018: b differs from beta_a, and less by
    # channel); the blend keeps that property.
    floor = min(beta)
    b = [b_over_beta * (0.5 * value + 0.5 * floor) for value in beta]
    return Medium(_rgb(beta), _rgb(b), B_inf, B_res, (1.2, 1.0, 0.9))


def _rgb(values: list[float]) -> Rgb:
    red, green, blue = (round(value, 4) for value in values)
    return red, green, blue


WATER_TYPES: dict[WaterType, Medium] = {
    "clear": Medium((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1, 1, 1)),
    "oceanic_IB": _jerlov((0.830, 0.950, 0.968), (0.03, 0.22, 0.42), 1.2, (0.004, 0.008, 0.012)),
    "oceanic_II": _jerlov((0.800, 0.925, 0.940), (0.04, 0.26, 0.40), 1.2, (0.006, 0.012, 0.016)),
    "coastal_1C": _jerlov((0.750, 0.885, 0.875), (0.05, 0.31, 0.36), 1.2, (0.010, 0.020, 0.022)),
    "coastal_3C": _jerlov((0.710, 0.820, 0.800), (0.07, 0.34, 0.31), 1.15, (0.015, 0.030, 0.028)),
    "coastal_5C": _jerlov((0.670, 0.730, 0.670), (0.10, 0.34, 0.24), 1.1, (0.022, 0.040, 0.032)),
}
"""From no water at all to green coastal water; keys are the names that the config accepts."""


_WRITTEN = ("beta_a", "b", "B_inf", "B_res", "d")
"""Of a medium; lamps of a synthetic dive have a truth of their own (lamps.py)."""


def save_medium(medium: Medium, path: Path) -> None:
    """Write the parameters with their units."""
    data: dict[str, object] = {
        "equation": "I = J exp(-beta_a z) + B_inf (1 - exp(-b z)) + B_res exp(-d z)",
        "units": {
            "z": "m, range along the ray",
            "beta_a": "1/m",
            "b": "1/m",
            "d": "1/m",
            "B_inf": "linear radiance in [0, 1]",
            "B_res": "linear radiance in [0, 1]",
        },
        "channels": "RGB",
    }
    data.update({name: [float(v) for v in getattr(medium, name)] for name in _WRITTEN})
    path.write_text(yaml.safe_dump(data, sort_keys=False))


def load_medium(path: Path) -> Medium:
    """Read what :func:`save_medium` wrote.

    Raises:
        InputError: the file is missing or is no medium file.
    """
    try:
        data = read_mapping(path, "water", "write the dive again")
        beta_a, b, B_inf, B_res, d = (_rgb_of(data[name]) for name in _WRITTEN)
        return Medium(beta_a, b, B_inf, B_res, d)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} does not hold the water's parameters ({reason_of(error)}); write the dive "
            "again"
        ) from error


def _rgb_of(row: Iterable[float]) -> Rgb:
    red, green, blue = map(float, row)
    return red, green, blue
