"""The numbers of a dive's ground, path and water, together with what each of them means."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import write_json
from aquaflow.base.storage.table import write_table
from aquaflow.survey.coverage.footprint import VISIBLE_CONTRAST
from aquaflow.survey.export.ortho.ground import LEAST_VIEWS, Ground
from aquaflow.survey.measure.areas import WELL_SEEN, areas, way
from aquaflow.survey.measure.height_field import HeightField
from aquaflow.survey.measure.quantity import NORMAL_95, Quantity, Scale
from aquaflow.survey.measure.roughness import (
    RELIEF_PERCENT,
    chain_ratio,
    relief,
    slope,
    surface_ratio,
)

Array = npt.NDArray[np.float64]

SLOPES = {"slope_p10": 10.0, "slope_median": 50.0, "slope_p90": 90.0}
"""Percentiles of the slope by the name of their number."""
LENGTHS = "lengths and areas"
NO_METRES = "the dive has no metres; `aquaflow measure scale` gives it some"
"""What is missing of a dive in map units, and why: one dive's are not another's."""


@dataclass(frozen=True)
class ReefNumber:
    """One of them."""

    key: str
    label: str
    """For people."""
    quantity: Quantity
    meaning: str


@dataclass(frozen=True)
class DiveWater:
    """What is known of a dive's water, in the unit of its lengths."""

    attenuation: list[float]
    """Of red, green and blue, per unit."""
    relative_sigma: list[float] | None


@dataclass(frozen=True)
class ReefNumbers:
    """All numbers that a dive has, and why it has no others."""

    numbers: list[ReefNumber]
    missing: dict[str, str]
    """By name of what is missing: the reason."""
    unit: str
    """Of lengths."""
    cell: float | None
    """Side of the cells on which the ground was measured."""
    vertical: str
    """What the ground was seen along, in words."""

    def to_json(self) -> dict[str, Any]:
        """The content of ``reef_numbers.json`` (docs/formats.md#reef-numbers)."""
        return {
            "unit": self.unit, "cell": self.cell, "vertical": self.vertical,
            "numbers": {
                each.key: each.quantity.to_json() | {"label": each.label, "meaning": each.meaning}
                for each in self.numbers
            },
            "missing": self.missing,
        }  # fmt: skip

    def rows(self) -> list[list[str]]:
        """The lines of ``reef_numbers.csv``, with a head."""
        lines = [["number", "value", "sigma", "low_95", "high_95", "unit", "meaning"]]
        for each in self.numbers:
            q = each.quantity
            values = [f"{v:.6g}" for v in (q.value, q.sigma, q.low, q.high)]
            lines.append([each.key, *values, q.unit, each.meaning])
        return lines


def reef_numbers(
    draw: Callable[[], tuple[HeightField, Ground]],
    places: Array,  # [N, 3] camera centres in n, in order of time
    water: DiveWater | None,
    scale: Scale,
) -> ReefNumbers:
    """The numbers of a dive.

    Args:
        draw: gives the ground, or raises InputError where there is none to measure.
        water: None: the medium is off.
        scale: of lengths in n.
    """
    numbers, missing = [], {}
    cell, vertical = None, ""
    try:
        field, ground = draw()
        cell, vertical = field.cell, ground.vertical
        numbers += of_area(field, scale, vertical)
        numbers += of_relief(field, scale, vertical)
    except InputError as error:
        missing["relief" if numbers else "ground"] = str(error)
    length = way(places, scale)
    if length is not None:
        meaning = "of the camera; its interval reaches down by what jitter may have added"
        numbers.append(ReefNumber("path_length", "length of the path", length, meaning))
    seen = water and visibility(water.attenuation, water.relative_sigma, scale)
    if seen:
        numbers.append(ReefNumber("visibility", "visibility range", seen, DEFINITION))
    else:
        missing["visibility"] = (
            "the water is too clear to measure, or the dive saw nothing at several ranges"
        )
    told = [each for each in numbers if _is_told(each, missing, scale)]
    return ReefNumbers(told, missing, scale.unit, cell, vertical)


def _is_told(number: ReefNumber, missing: dict[str, str], scale: Scale) -> bool:
    """False of what has no metres, or an interval that says nothing; then ``missing`` has why."""
    quantity = number.quantity
    if quantity.unit and scale.unit != "m" and quantity.unit.endswith(scale.unit):
        missing[LENGTHS] = NO_METRES
        return False
    if not quantity.says_something:
        missing[number.key] = f"its 95 % interval, {quantity.interval_in_words()}, says nothing"
        return False
    return True


def of_area(field: HeightField, scale: Scale, vertical: str) -> list[ReefNumber]:
    """Areas and shares; without that of the surface where too little is mapped for its relief."""
    try:
        ratio = surface_ratio(field, scale.tilt_sigma_rad)
    except InputError:
        ratio = None
    found = areas(field, ratio, scale)
    listed = [
        ("surveyed_area", "surveyed area", found.surveyed,
         f"on the plan, of what {LEAST_VIEWS} mapped pictures show, vertical: {vertical}"),
        ("surface_area", "its surface", found.surface,
         f"with its relief on {_cells(field, scale, vertical)}; what is not mapped is taken to be "
         "as rough as the rest"),
        ("mapped_share", "share that is in the map", found.mapped, "of the surveyed area"),
        ("seldom_seen_share", f"share that fewer than {WELL_SEEN} pictures show", found.seldom,
         "of the surveyed area"),
    ]  # fmt: skip
    return [
        ReefNumber(key, label, quantity, meaning)
        for key, label, quantity, meaning in listed
        if quantity is not None
    ]


def of_relief(field: HeightField, scale: Scale, vertical: str) -> list[ReefNumber]:
    """Rugosity, relief and slope.

    Raises:
        InputError: too little is mapped.
    """
    tilt, cells = scale.tilt_sigma_rad, _cells(field, scale, vertical)
    ends = f"{RELIEF_PERCENT[0]:g} % and {RELIEF_PERCENT[1]:g} %"
    listed = [
        ("rugosity", "rugosity, surface over plan", surface_ratio(field, tilt),
         f"area of the surface over that of its plan, on {cells}"),
        ("chain_rugosity", "rugosity, chain over line", chain_ratio(field, tilt),
         f"length of virtual chains over that of their lines, on {cells}, one link a cell"),
        ("relief", "relief", relief(field, tilt, scale.sigma, scale.unit),
         f"height between {ends} of the cells, on {cells}"),
        *((key, f"slope, {percent:g} %", slope(field, percent, tilt),
           f"{percent:g} % of the ground is less steep, on {cells}")
          for key, percent in SLOPES.items()),
    ]  # fmt: skip
    return [ReefNumber(*each) for each in listed]


def _cells(field: HeightField, scale: Scale, vertical: str) -> str:
    return f"cells of {field.cell:g} {scale.unit}, vertical: {vertical}"


# --------------------------------------------------------------------------------------------------
# How far one sees in the water of a dive, from its attenuation.

DEFINITION = (
    "range at which contrasts of the scene fall to 5 %: ln(20) / attenuation (Koschmieder's law), "
    "in the colour that reaches farthest; for the light there was and this camera's colours"
)


def visibility(
    attenuation: Sequence[float],
    relative_sigma: Sequence[float] | None,
    scale: Scale,
) -> Quantity | None:
    """The visibility range; None where attenuation is no measurement.

    Args:
        attenuation: of red, green and blue, per unit of length of ``scale``.
        relative_sigma: 1 sigma of each over its value, with the scale as exact; None: unknown, as
            where the ranges that were seen never allowed a fit.
    """
    if relative_sigma is None:
        return None
    known = [
        (rate, sigma)
        for rate, sigma in zip(attenuation, relative_sigma, strict=True)
        if rate > 0.0 and math.isfinite(rate) and math.isfinite(sigma)
    ]
    if not known:
        return None
    rate, relative = min(known)
    relative = math.hypot(relative, scale.sigma)
    value = -math.log(VISIBLE_CONTRAST) / rate
    # A rate's error is one of its logarithm: twice the rate is as likely as half of it.
    factor = math.exp(NORMAL_95 * relative)
    return Quantity(value, value * relative, value / factor, value * factor, scale.unit)


# --------------------------------------------------------------------------------------------------
# ``reef_numbers.json`` and ``reef_numbers.csv``.

JSON, CSV = "reef_numbers.json", "reef_numbers.csv"
"""In the dive folder."""


def write_reef_numbers(folder: Path, found: ReefNumbers) -> None:
    """Write both files.

    Raises:
        InputError: a file cannot be written.
    """
    write_json(folder / JSON, found.to_json())
    write_table(folder / CSV, found.rows())
