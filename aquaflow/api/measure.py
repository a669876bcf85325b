"""Measuring in a finished dive from Python, as ``aquaflow measure`` does on the command line."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from aquaflow.dive.dive import MAP, Dive
from aquaflow.survey.measure.quantity import Quantity

if TYPE_CHECKING:
    from aquaflow.survey.measure.asked import Asked


def measure(
    dive: Dive | str | os.PathLike[str],
    points: Sequence[str | Sequence[float]] = (),
    *,
    shape: Literal["line", "area", "profile"] | None = None,
    cell: float | None = None,
) -> dict[str, Quantity]:
    """Measure between points of a dive's largest sub-map, or without points its ground.

    Args:
        points: ``(x, y, z)`` in the dive's world and unit; or a text: ``"FRAME:u,v"``, a pixel of a
            mapped picture, or ``"63.4305N,10.3951E"``.
        shape: of the points; None: a line of two, an area of more.
        cell: side of the cells on which the ground is measured, in the dive's unit; None: found
            from the map's resolution.

    Returns:
        By name, such as ``length`` or ``rugosity``: ``value``, ``sigma`` (1 sigma), ``low`` and
        ``high`` (they hold the truth with 95 %), all in ``unit``. What the dive does not know is
        missing.

    Raises:
        InputError: there is no finished dive with a map, or a point or the shape cannot be
            measured.
        ConfigError: the dive's settings cannot be read.
    """
    read = dive if isinstance(dive, Dive) else Dive(dive)
    read.require(MAP)
    asked = [_asked(point) for point in points]
    with tempfile.TemporaryDirectory() as work:
        if asked:
            from aquaflow.survey.measure.answers import answer  # loads torch

            return answer(read, asked, shape, Path(work), cell).quantities
        from aquaflow.survey.measure.finished_dive import numbers_of_dive

        numbers = numbers_of_dive(read, Path(work), cell).numbers
        return {each.key: each.quantity for each in numbers}


def _asked(point: str | Sequence[float]) -> Asked:
    from aquaflow.survey.measure.asked import parse_point

    return parse_point(point if isinstance(point, str) else ",".join(map(repr, map(float, point))))
