"""The scale bar: two points of the map and the true length between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

from aquaflow.base.errors import InputError
from aquaflow.survey.viewer.measuring import Asked, vector

Place: TypeAlias = tuple[float, float, float]
Mark: TypeAlias = Callable[[tuple[Place, Place], float, float], tuple[str, bool]]
"""Keeps a length between two points of the map: metres and 1 sigma of them. Returns sentences about
it, and whether the dive's files were rescaled."""


def marked(given: Asked, mark: Mark) -> Asked:
    """What a browser is told of the scale bar that it asked for.

    Raises:
        InputError: it is none, or a file of the dive cannot be read or written.
    """
    places = given.get("places")
    if not isinstance(places, list) or len(places) != 2:
        raise InputError("a scale bar has two ends; mark both")
    a, b = (vector(place, "an end of the scale bar") for place in places)
    length, sigma = (_metres(given.get(name), name) for name in ("length_m", "sigma_m"))
    words, rescaled = mark(((a[0], a[1], a[2]), (b[0], b[1], b[2])), length, sigma)
    return {"words": words, "rescaled": rescaled}


def _metres(given: Any, name: str) -> float:
    if not isinstance(given, (int, float)) or not 0.0 < given < math.inf:
        what = "length" if name == "length_m" else "1 sigma"
        raise InputError(f"the {what} of the scale bar must be a positive number of metres")
    return float(given)
