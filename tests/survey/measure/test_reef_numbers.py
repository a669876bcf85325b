"""Which numbers of a dive are given, which are missing and why, and along which vertical."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.dive.placement import Placement
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.export.ortho.ground import ALONG_GRAVITY, Ground
from aquaflow.survey.measure.quantity import Quantity, Scale
from aquaflow.survey.measure.reef_numbers import DiveWater, ReefNumbers, reef_numbers
from tests.survey.measure.fields import field

METRES, UNITS = Scale("m", 0.01, 0.0), Scale("map units", 0.0, 0.0)
PATH = np.column_stack([np.linspace(0.0, 5.0, 50), np.zeros(50), np.zeros(50)])
WATER = DiveWater([0.3, 0.2, 0.4], [0.05] * 3)


def found(scale: Scale, water: DiveWater = WATER) -> ReefNumbers:
    """Of a slope of 20 degrees with waves."""
    where = Placement(Sim3.identity(), scale.unit, ("right", "forward"))
    ground = Ground(Sim3.identity(), where, (0.0, 0.0), 1.0, ALONG_GRAVITY, "the dive's start")
    steep = float(np.tan(np.radians(20.0)))
    drawn = field(lambda x, y: steep * x + 0.1 * np.sin(3.0 * y))
    return reef_numbers(lambda: (drawn, ground), PATH, water, scale)


def keys(numbers: ReefNumbers) -> set[str]:
    return {each.key for each in numbers.numbers}


def test_without_metres_a_dive_has_shares_ratios_and_angles_alone() -> None:
    metric, bare = found(METRES), found(UNITS)
    lengths = {"surveyed_area", "surface_area", "relief", "path_length", "visibility"}
    assert keys(metric) - keys(bare) == lengths
    assert metric.missing == {}
    assert set(bare.missing) == {"lengths and areas"}
    assert "measure scale" in bare.missing["lengths and areas"]
    assert {each.quantity.unit for each in bare.numbers} == {"", "\u00b0"}


def test_a_number_whose_interval_says_nothing_is_missing_with_its_interval() -> None:
    murky = found(METRES, DiveWater([0.3, 0.2, 0.4], [0.6] * 3))
    assert "visibility" not in keys(murky)
    assert murky.missing["visibility"] == "its 95 % interval, 4.6 to 48.6, says nothing"
    assert keys(found(Scale("m", 0.4, 0.0))).isdisjoint({"surveyed_area", "relief"})


def test_every_number_of_the_ground_names_the_vertical() -> None:
    told = {each.key: each.meaning for each in found(METRES).numbers}
    for key in ("surveyed_area", "surface_area", "rugosity", "chain_rugosity", "relief"):
        assert "vertical: along gravity" in told[key], key
    assert "vertical: along gravity" in told["slope_median"]


def test_a_vertical_that_errs_makes_rugosity_of_a_slope_uncertain() -> None:
    exact, tilted = ({e.key: e.quantity for e in found(Scale("m", 0.0, tilt)).numbers}
                     for tilt in (0.0, 0.02))  # fmt: skip
    value = exact["rugosity"]
    added = np.sqrt(tilted["rugosity"].sigma ** 2 - value.sigma**2)
    # Area over plan is 1 / cos of the slope: its derivative is tan of it.
    assert added == pytest.approx(value.value * np.tan(np.radians(20.0)) * 0.02, rel=0.05)


@pytest.mark.parametrize(
    ("quantity", "told"),
    [
        (Quantity(9.0, 51.0, 0.0, 109.0, "m\u00b2"), False),
        (Quantity(1.0, 2.8, 1.0, 12.0, ""), False),
        (Quantity(0.02, 0.02, 0.0, 0.06, ""), True),
        (Quantity(0.5, 0.2, 0.1, 0.9, ""), False),
        (Quantity(2.0, 1.5, 0.0, 5.0, "\u00b0"), True),
        (Quantity(20.0, 14.0, 0.0, 48.0, "\u00b0"), False),
        (Quantity(4.44, 0.2, 4.05, 4.83, "m"), True),
    ],
)
def test_what_an_interval_says_depends_on_what_is_possible(quantity: Quantity, told: bool) -> None:
    assert quantity.says_something is told


def test_an_interval_is_written_with_the_digits_of_its_sigma() -> None:
    assert Quantity(4.441, 0.203, 4.043, 4.839, "m").interval_in_words() == "4.04 to 4.84"
    assert Quantity(912.4, 51.2, 812.0, 1012.8, "m\u00b2").interval_in_words() == "812 to 1013"
    assert Quantity(1.0, 0.0, 1.0, 1.0, "").interval_in_words() == "1 to 1"
