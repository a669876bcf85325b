"""How much ground a dive surveyed, and how often it was seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.optimise.robust import sigma_of
from aquaflow.survey.export.ortho.ground import LEAST_VIEWS
from aquaflow.survey.measure.height_field import Counts, HeightField
from aquaflow.survey.measure.quantity import NORMAL_95, Quantity, Scale

WELL_SEEN = 3
"""Pictures that make a place well seen: two have parallax, a third contradicts a wrong match."""


@dataclass(frozen=True)
class Areas:
    """Areas on the chart, seen from straight above."""

    surveyed: Quantity
    """That LEAST_VIEWS mapped pictures show, at least."""
    surface: Quantity | None
    """Of the ground there with its relief, at the size of the cells; None without rugosity."""
    mapped: Quantity
    """Share of the surveyed area that has a height in the map."""
    seldom: Quantity
    """Share of the surveyed area that fewer than WELL_SEEN pictures show."""


def areas(field: HeightField, ratio: Quantity | None, scale: Scale) -> Areas:
    """``ratio``: surface over plan, as :func:`aquaflow.survey.measure.roughness.surface_ratio`
    has it; None where it is unknown."""
    surveyed = _survey_area(field, scale)
    seen = field.held.plain >= LEAST_VIEWS
    count = max(1, int(seen.sum()))
    mapped = float((field.mapped & seen).sum()) / count
    edge = _edge_sigma(field) / max(surveyed.value, field.cell**2)
    shares = [_seldom(counts) for counts in _all(field)]
    # Holes are alike, the feet of what stands there: their guessed heights may err together.
    apart = float(np.hypot(0.5 * np.ptp(shares[:3]), shares[3] - shares[0]))
    return Areas(
        surveyed,
        None if ratio is None else _surface(surveyed, ratio, mapped, scale),
        _share(mapped, mapped * edge),
        _share(shares[0], apart),
    )


def _all(field: HeightField) -> tuple[Counts, ...]:
    held = field.held
    return held.plain, held.narrow, held.wide, held.raised


def _survey_area(field: HeightField, scale: Scale) -> Quantity:
    size = float((field.held.plain >= LEAST_VIEWS).sum()) * field.cell**2
    sigma = float(np.hypot(_edge_sigma(field), 2.0 * scale.sigma * size))
    return Quantity.normal(size, sigma, scale.square_unit)


def _edge_sigma(field: HeightField) -> float:
    """1 sigma of the area that follows from where its edge lies.

    All pictures may end a pixel off together. Where nothing is mapped the ground may be higher or
    lower: in one direction along as much of the edge as a picture shows, in another one beyond.
    """
    plain, narrow, wide, raised = (
        float((counts >= LEAST_VIEWS).sum()) * field.cell**2 for counts in _all(field)
    )
    together = 0.5 * (wide - narrow)
    alone = abs(raised - plain) / np.sqrt(_pieces(field))
    # A cell is in or out as a whole: uniform, each on its own.
    rounding = field.cell * np.sqrt(_perimeter(field) * field.cell / 12.0)
    return float(np.linalg.norm([together, alone, rounding]))


def _pieces(field: HeightField) -> float:
    """Of the edge, that err on their own."""
    return max(1.0, _perimeter(field) / field.reach)


def _perimeter(field: HeightField) -> float:
    """Of the surveyed area: sides of cells between in and out, times pi / 4, by which steps are
    longer than the line that they follow, in the mean over its directions (Crofton)."""
    inside = np.pad(field.held.plain >= LEAST_VIEWS, 1).astype(np.int8)
    sides = sum(int(np.abs(np.diff(inside, axis=axis)).sum()) for axis in (0, 1))
    return 0.25 * np.pi * sides * field.cell


def _surface(surveyed: Quantity, ratio: Quantity, mapped: float, scale: Scale) -> Quantity:
    """What is not mapped may be flat, or twice as rough as the rest beyond flat."""
    value = surveyed.value * ratio.value
    guessed = (1.0 - mapped) * (ratio.value - 1.0) / np.sqrt(3.0) * surveyed.value
    common = float(np.hypot(ratio.value * surveyed.sigma, guessed))
    low, high = (
        float(np.hypot(NORMAL_95 * common, surveyed.value * abs(end - ratio.value)))
        for end in (ratio.low, ratio.high)
    )
    sigma = float(np.hypot(common, surveyed.value * ratio.sigma))
    return Quantity(value, sigma, max(0.0, value - low), value + high, scale.square_unit)


def _seldom(
    counts: Counts,  # [h, w]
) -> float:
    surveyed = int((counts >= LEAST_VIEWS).sum())
    return float(((counts >= LEAST_VIEWS) & (counts < WELL_SEEN)).sum()) / max(1, surveyed)


def _share(value: float, sigma: float) -> Quantity:
    found = Quantity.normal(value, sigma, "")
    return Quantity(value, sigma, found.low, min(1.0, found.high), "")


# --------------------------------------------------------------------------------------------------
# The length of the camera's way.

Array = npt.NDArray[np.float64]

THIRD_DIFFERENCES = 20.0
"""Variance of a third difference over that of one place: 1 + 9 + 9 + 1."""
LEAST_POSES = 5
"""For two third differences."""


def way(
    places: Array,  # [N, 3] camera centres in order of time
    scale: Scale,
) -> Quantity | None:
    """The way through all places; None where there are fewer than two.

    Jitter of the poses lengthens it. Third differences of the places, in which a steady motion
    cancels, bound the jitter; what the vehicle's own unrest adds to them is taken for jitter, too,
    so that the interval reaches down farther than it has to and the value is left as measured.
    """
    if len(places) < 2:
        return None
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    value = float(lengths.sum())
    longer = 0.0
    if len(places) >= LEAST_POSES:
        third = np.diff(places, 3, axis=0)
        jitter = sigma_of(third) / np.sqrt(THIRD_DIFFERENCES)
        # Three directions, and both ends of each step: E |d + n|^2 = |d|^2 + 6 sigma^2.
        shorter = np.sqrt(np.maximum(lengths**2 - 6.0 * jitter**2, 0.0))
        longer = float((lengths - shorter).sum())
    half = NORMAL_95 * scale.sigma * value
    low = max(0.0, value - float(np.hypot(half, longer)))
    sigma = (half + value - low) / (2.0 * NORMAL_95)
    return Quantity(value, sigma, low, value + half, scale.unit)
