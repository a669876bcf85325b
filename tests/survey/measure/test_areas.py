"""Areas of a disc that pictures show, and how well its edge is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.survey.measure.areas import Areas, areas
from aquaflow.survey.measure.height_field import HeightField, Held
from aquaflow.survey.measure.quantity import Quantity, Scale
from tests.survey.measure.fields import CELL, field

RADIUS, EDGE = 2.2, 0.05
FLAT = Quantity(1.0, 0.0, 1.0, 1.0, "")
EXACT = Scale("m", 0.0, 0.0)


def surface(found: Areas) -> Quantity:
    assert found.surface is not None
    return found.surface


def disc(radius: float) -> npt.NDArray[np.int32]:
    """[60, 60] five pictures within the radius, two in the rim of 0.4 around, none beyond."""
    places = (np.arange(60) + 0.5) * CELL - 3.0
    far = np.hypot(*np.meshgrid(places, places))
    return np.where(far < radius - 0.4, 5, np.where(far < radius, 2, 0)).astype(np.int32)


def seen(raised: float = RADIUS) -> HeightField:
    sides = (RADIUS, RADIUS - EDGE, RADIUS + EDGE, raised)
    return replace(field(lambda x, y: 0.0 * x), held=Held(*map(disc, sides)))


def test_the_area_is_that_of_the_disc_and_its_interval_that_of_the_edge() -> None:
    found = areas(seen(), FLAT, EXACT)
    assert found.surveyed.value == pytest.approx(np.pi * RADIUS**2, rel=0.01)
    assert found.surveyed.sigma == pytest.approx(2.0 * np.pi * RADIUS * EDGE, rel=0.15)
    assert found.surveyed.unit == "m\u00b2"
    rim = 1.0 - ((RADIUS - 0.4) / RADIUS) ** 2
    assert found.seldom.low <= rim <= found.seldom.high
    assert found.mapped.value == 1.0
    assert found.mapped.high == 1.0


def test_guessed_heights_at_the_edge_widen_the_interval() -> None:
    pieces = np.sqrt(2.0 * np.pi * RADIUS / 2.0)
    plain, raised = (areas(seen(r), FLAT, EXACT).surveyed.sigma for r in (RADIUS, RADIUS - 0.5))
    grown = np.pi * (RADIUS**2 - (RADIUS - 0.5) ** 2)
    assert np.sqrt(raised**2 - plain**2) == pytest.approx(grown / pieces, rel=0.1)
    assert areas(seen(RADIUS - 0.5), FLAT, EXACT).seldom.sigma > 0.0


def test_the_scale_counts_twice() -> None:
    exact, found = (areas(seen(), FLAT, Scale("m", s, 0.0)).surveyed for s in (0.0, 0.05))
    assert np.sqrt(found.sigma**2 - exact.sigma**2) == pytest.approx(0.1 * found.value)


def test_the_surface_is_as_much_larger_as_it_is_rough() -> None:
    ratio = Quantity(1.2, 0.02, 1.17, 1.25, "")
    found = areas(seen(), ratio, EXACT)
    assert surface(found).value == pytest.approx(1.2 * found.surveyed.value)
    assert surface(found).high - surface(found).value > 0.05 * found.surveyed.value
    assert surface(found).low < 1.17 * found.surveyed.value


def test_what_is_not_mapped_makes_the_surface_less_sure() -> None:
    whole, ratio = seen(), Quantity(1.2, 0.0, 1.2, 1.2, "")
    height = whole.height.copy()
    height[:, :30] = np.nan
    half = areas(replace(whole, height=height), ratio, EXACT)
    assert half.mapped.value == pytest.approx(0.5, abs=0.01)
    assert surface(half).sigma > 1.3 * surface(areas(whole, ratio, EXACT)).sigma


def test_without_rugosity_there_is_no_surface() -> None:
    assert areas(seen(), None, EXACT).surface is None
