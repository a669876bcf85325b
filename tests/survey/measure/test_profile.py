"""Heights along a line, and how well each is known against the others."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.errors import InputError
from aquaflow.survey.measure.points import MeasuredPoints
from aquaflow.survey.measure.quantity import Scale
from aquaflow.survey.measure.shapes import profile

Array = npt.NDArray[np.float64]

UP = np.array([0.0, 0.0, -1.0])
ALONG = np.linspace(0.0, 3.0, 13)
TURN = np.radians(30.0)


def line(own: float = 0.0, shared: float = 0.0) -> MeasuredPoints:
    """A ground that rises by 0.1 over 3, with waves, along a bearing of 30 degrees."""
    height = ALONG / 30.0 + 0.2 * np.sin(3.0 * ALONG)
    places = np.stack([ALONG * np.cos(TURN), ALONG * np.sin(TURN), 8.0 - height], axis=1)
    return MeasuredPoints.round(places, np.full(13, own), np.full(13, shared), 2.0)


def test_heights_and_distances_are_those_of_the_line() -> None:
    found = profile(line(), UP, Scale("m", 0.0, 0.0))
    np.testing.assert_allclose(found.along, ALONG, atol=1e-12)
    np.testing.assert_allclose(found.height, ALONG / 30.0 + 0.2 * np.sin(3.0 * ALONG) - 8.0)
    assert found.drop.value == pytest.approx(0.1 + 0.2 * np.sin(9.0))
    assert found.drop.sigma == 0.0


def test_intervals_hold_the_shape_of_the_ground_as_often_as_they_say() -> None:
    scale, rng = Scale("m", 0.02, 0.01), np.random.default_rng(3)
    exact = line(0.005, 0.03)
    truth = profile(exact, UP, Scale("m", 0.0, 0.0))
    noise = rng.multivariate_normal(np.zeros(39), exact.covariance(), 400).reshape(-1, 13, 3)
    noise[..., :2] = 0.0  # along the line, the ground itself changes
    inside, drops = 0.0, 0
    for each in noise:
        tilt, factor = 0.01 * rng.standard_normal(), 1.0 + 0.02 * rng.standard_normal()
        places = exact.places + each
        places[:, 2] = factor * places[:, 2] + tilt * ALONG
        seen = profile(MeasuredPoints(places, exact.own, exact.shared, exact.reach), UP, scale)
        shift = truth.height.mean() - seen.height.mean()
        inside += np.mean((seen.low + shift <= truth.height) & (truth.height <= seen.high + shift))
        drops += seen.drop.low <= truth.drop.value <= seen.drop.high
    assert 0.93 < inside / 400 < 0.97
    assert 0.925 < drops / 400 < 0.98


def test_what_the_whole_line_errs_together_is_no_error_of_its_shape() -> None:
    count = len(ALONG)
    together = MeasuredPoints.round(line().places, np.zeros(count), np.full(count, 0.5), 1e6)
    assert profile(together, UP, Scale("m", 0.0, 0.0)).sigma.max() < 1e-3


@pytest.mark.parametrize(
    ("places", "sentence"),
    [
        (np.zeros((1, 3)), "2 points"),
        (np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 4.0]]), "above each other"),
    ],
)
def test_a_line_without_length_is_refused(places: Array, sentence: str) -> None:
    points = MeasuredPoints.round(places, np.zeros(len(places)), np.zeros(len(places)), 1.0)
    with pytest.raises(InputError, match=sentence):
        profile(points, UP, Scale("m", 0.0, 0.0))
