"""Lengths and areas: their values, and that their intervals hold the truth as often as they say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.errors import InputError
from aquaflow.survey.measure.points import MOST_POINTS, MeasuredPoints
from aquaflow.survey.measure.quantity import Quantity, Scale, scale_of
from aquaflow.survey.measure.shapes import area, distance, path_length, plan_area
from tests.metric_scenes import SIGMAS, metric_frame

Array = npt.NDArray[np.float64]

METRES = Scale("m", 0.01, 0.0)
EXACT = Scale("m", 0.0, 0.0)
DOWN, UP = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
SQUARE = np.array([[0.0, 0.0, 5.0], [2.0, 0.0, 5.0], [2.0, 2.0, 5.0], [0.0, 2.0, 5.0]])
BENT = np.array([[0.0, 0.0, 5.0], [1.0, 0.2, 5.3], [1.8, 0.9, 5.1], [3.0, 1.0, 4.8]])


def marked(
    places: Array, own: float = 0.0, shared: float = 0.0, reach: float = 2.0
) -> MeasuredPoints:
    count = len(places)
    return MeasuredPoints.round(places, np.full(count, own), np.full(count, shared), reach)


def coverage(
    measure: Callable[[MeasuredPoints, Scale], Quantity],
    places: Array,
    scale: Scale,
    shared: float = 0.03,
) -> float:
    """How often the 95 % interval of a measurement with errors holds the true value."""
    rng = np.random.default_rng(7)
    exact = marked(places, 0.01, shared)
    truth = measure(exact, EXACT).value
    noise = rng.multivariate_normal(np.zeros(places.size), exact.covariance(), 600)
    factors = 1.0 + scale.sigma * rng.standard_normal(600)
    found = 0
    for each, factor in zip(noise, factors, strict=True):
        seen = factor * (places + each.reshape(-1, 3))
        said = measure(marked(seen, 0.01, shared), scale)
        found += said.low <= truth <= said.high
    return found / 600


def test_values_are_those_of_geometry() -> None:
    assert distance(marked(BENT[:2]), METRES).value == pytest.approx(np.sqrt(1.13))
    steps = np.linalg.norm(np.diff(BENT, axis=0), axis=1)
    assert path_length(marked(BENT), METRES).value == pytest.approx(steps.sum())
    assert area(marked(SQUARE), METRES).value == pytest.approx(4.0)
    corner = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    assert area(marked(corner), METRES).value == pytest.approx(6.0)
    assert plan_area(marked(corner[:, [0, 2, 1]]), UP, METRES).value == pytest.approx(6.0)
    slope = SQUARE + np.array([0.0, 0.0, 1.0]) * SQUARE[:, :1]
    assert area(marked(slope), METRES).value == pytest.approx(4.0 * np.sqrt(2.0))
    assert plan_area(marked(slope), UP, METRES).value == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("measure", "places"),
    [(distance, BENT[:2]), (path_length, BENT), (area, SQUARE)],
    ids=["distance", "path", "area"],
)
@pytest.mark.parametrize("scale", [EXACT, METRES], ids=["exact", "1 %"])
def test_intervals_hold_the_truth_as_often_as_they_say(
    measure: Callable[[MeasuredPoints, Scale], Quantity], places: Array, scale: Scale
) -> None:
    assert 0.925 < coverage(measure, places, scale) < 0.98


def test_the_area_on_a_chart_has_an_interval_that_holds() -> None:
    def measure(points: MeasuredPoints, scale: Scale) -> Quantity:
        return plan_area(points, UP, scale)

    assert 0.925 < coverage(measure, SQUARE, METRES) < 0.98


def test_a_length_as_short_as_its_error_is_not_called_exact() -> None:
    near = np.array([[0.0, 0.0, 5.0], [0.02, 0.0, 5.0]])
    assert coverage(distance, near, EXACT, shared=0.05) > 0.95
    same = distance(marked(np.zeros((2, 3)), 0.01), METRES)
    assert same.value == 0.0
    assert same.sigma == pytest.approx(0.01 * np.sqrt(6.0))
    assert same.low == 0.0


def test_errors_that_neighbours_share_leave_the_length_between_them() -> None:
    near, far = BENT[:2], BENT[:2] * 10.0
    alone = [distance(marked(places, own=0.05), EXACT).sigma for places in (near, far)]
    shared = [distance(marked(places, shared=0.05), EXACT).sigma for places in (near, far)]
    assert shared[0] < 0.75 * alone[0]
    assert shared[1] == pytest.approx(alone[1], rel=0.01)


def test_the_scale_counts_once_in_lengths_and_twice_in_areas() -> None:
    length, size = path_length(marked(BENT), METRES), area(marked(SQUARE), METRES)
    assert length.sigma == pytest.approx(0.01 * length.value)
    assert size.sigma == pytest.approx(0.02 * size.value)
    assert (length.unit, size.unit) == ("m", "m\u00b2")


def test_a_dive_without_metres_answers_in_map_units() -> None:
    scale = scale_of(metric_frame(metric=False))
    assert distance(marked(BENT[:2]), scale).in_words() == "1.063 map units"
    assert area(marked(SQUARE), scale).unit == "square map units"
    assert scale.sigma == 0.0
    assert scale_of(metric_frame()).sigma == pytest.approx(SIGMAS[6])


def test_words_have_the_digits_that_sigma_leaves() -> None:
    assert Quantity.normal(12.3456, 0.05, "m").in_words() == "12.346 \u00b1 0.050 m"
    assert Quantity.normal(123.4, 15.0, "m").in_words() == "123 \u00b1 15 m"
    assert Quantity.normal(0.987654, 0.0, "").in_words() == "0.9877"
    assert Quantity.normal(0.01, 0.05, "m").to_json()["low_95"] == 0.0


@pytest.mark.parametrize(
    ("measure", "count", "sentence"),
    [(distance, 3, "has 2 points"), (path_length, 1, "2 points"), (area, 2, "3 points")],
)
def test_too_few_or_too_many_points_are_refused(
    measure: Callable[[MeasuredPoints, Scale], Quantity], count: int, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        measure(marked(BENT[:count]), METRES)


def test_an_outline_that_crosses_itself_is_refused() -> None:
    crossed = SQUARE[[0, 2, 1, 3]] * np.array([1.0, 1.5, 1.0]) + 0.1 * BENT
    with pytest.raises(InputError, match="crosses itself"):
        area(marked(crossed), METRES)
    with pytest.raises(InputError, match="crosses itself"):
        plan_area(marked(crossed), UP, METRES)


def test_points_that_are_not_finite_or_too_many_are_refused() -> None:
    with pytest.raises(InputError, match="not finite"):
        marked(np.array([[0.0, np.nan, 0.0]]))
    with pytest.raises(InputError, match="too many"):
        marked(np.zeros((MOST_POINTS + 1, 3)))
