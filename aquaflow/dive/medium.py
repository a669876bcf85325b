"""The water of a dive as plain numbers, and the image formation that they are of."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, reason_or_key
from aquaflow.water.mounting import Lamp

Rgb: TypeAlias = tuple[float, float, float]
FloatArray: TypeAlias = npt.NDArray[np.floating]

NAME = "medium.json"
"""In a dive's folder (docs/formats.md#medium-json)."""


@dataclass(frozen=True)
class Medium:
    """Parameters of the image formation, RGB: at range z along the ray a camera sees of radiance J

        J exp(-beta_a z) lit(z) + B_inf (1 - exp(-b z)) + B_res exp(-d z)

    with lit(z) = 1 by daylight, and by a ``lamp`` beside the camera
    lit(z) = 1 - share + share (range / z)^power exp(-beta_a z).

    Lengths are in metres in the truth of a synthetic dive, and in its own unit in a mapped dive.
    """

    beta_a: Rgb
    """Attenuation, 1/m."""
    b: Rgb
    """Growth of the backscatter, 1/m."""
    B_inf: Rgb
    """Colour of infinitely deep water, radiance in [0, 1]."""
    B_res: Rgb
    """Near residual of the backscatter, radiance in [0, 1]."""
    d: Rgb
    """Decay of the near residual, 1/m."""
    lamp: Lamp | None = None
    """Light from beside the camera: its ``share``, ``power`` and ``range``, and where it is; None
    where the dive shows none."""

    def looking(
        self,
        axis: FloatArray,  # [3] unit, the optical axis in the world (x north, z down)
        change: float,
    ) -> Medium:
        """The water of a camera that looks along ``axis``; ``change`` is config's
        ``directional_attenuation``."""
        if change == 0.0:
            return self
        factor = 1.0 + change * float(axis[0])
        red, green, blue = self.beta_a
        return replace(self, beta_a=(factor * red, factor * green, factor * blue))

    def under(
        self,
        light: float,  # over that of before
    ) -> Medium:
        """The same water by less or more daylight."""
        B_inf, B_res = (
            (light * red, light * green, light * blue)
            for red, green, blue in (self.B_inf, self.B_res)
        )
        return replace(self, B_inf=B_inf, B_res=B_res)

    def transmission(
        self,
        z: FloatArray,  # [...]
    ) -> FloatArray:
        """exp(-beta_a z) lit(z), [..., 3], for ranges z [...] in the unit of length: the share of
        J that is seen."""
        beta_a = np.asarray(self.beta_a, z.dtype)
        T = np.asarray(np.exp(-beta_a * z[..., None]))
        return T if self.lamp is None else np.asarray(T * self.lamp.light(beta_a, z), z.dtype)

    def backscatter(
        self,
        z: FloatArray,  # [...]
    ) -> FloatArray:
        """B(z), [..., 3], for ranges z [...] in the unit of length; infinite z gives B_inf."""
        kind = z.dtype
        grown = np.asarray(self.B_inf, kind) * (
            1 - np.exp(-np.asarray(self.b, kind) * z[..., None])
        )
        return np.asarray(
            grown + np.asarray(self.B_res, kind) * np.exp(-np.asarray(self.d, kind) * z[..., None])
        )

    def compose(
        self,
        clean: FloatArray,  # [..., 3] radiance J
        z: FloatArray,  # [...] m, inf where nothing is hit
    ) -> FloatArray:
        """The colour I [..., 3] that reaches the camera."""
        return np.asarray(clean * self.transmission(z) + self.backscatter(z))


def medium_of(facts: Mapping[str, Any], file: Path) -> Medium | None:
    """The water that the ``facts`` of ``medium.json`` state, in the unit that they are in; None
    where none is modelled. ``file``: for the sentence of the error.

    Raises:
        InputError: they are not a dive's medium.
    """
    try:
        if not facts["active"]:
            return None
        scattered = facts["backscatter"]
        return Medium(
            beta_a=_rgb(facts["attenuation_per_unit"]),
            b=_rgb(scattered["b"]),
            B_inf=_rgb(scattered["B_inf"]),
            B_res=_rgb(scattered["B_res"]),
            d=_rgb(scattered["d"]),
            lamp=lamp_of(facts),
        )
    except (ValueError, KeyError, TypeError) as error:
        why = f"cannot read the medium {file}: {reason_or_key(error)}; map the dive again"
        raise InputError(why) from error


def lamp_of(facts: Mapping[str, Any]) -> Lamp | None:
    """The lamp that the ``facts`` of ``medium.json`` state, in the unit that they are in; None
    where there is none, and in dives from before 2026-11-26.

    Raises:
        ValueError, KeyError, TypeError: they are not a dive's medium.
    """
    stated = facts.get("lamp")
    if stated is None:
        return None
    lamp = Lamp.of(stated)
    if not (0.0 <= lamp.share <= 1.0 and math.isfinite(lamp.power) and 0.0 < lamp.range < math.inf):
        raise DamagedError("the lamp is no share of light, power and range")
    return lamp


def _rgb(value: object) -> Rgb:
    """Three finite, non-negative numbers."""
    channels = np.asarray(value, dtype=np.float64)
    if channels.shape != (3,) or not np.isfinite(channels).all() or (channels < 0.0).any():
        raise DamagedError("a colour is not three numbers of at least 0")
    red, green, blue = channels.tolist()
    return red, green, blue
