"""Learned ranges fill what triangulation leaves, in one unit, and say how little they know."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.learned_range import LearnedRange, filled

CAMERA = CameraModel(40, 30, 40.0, 40.0, 20.0, 15.0)
Float = npt.NDArray[np.float32]


def rays() -> npt.NDArray[np.float64]:
    """[30, 40, 3] of length 1."""
    found = CAMERA.unproject(CAMERA.pixel_centres())
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def triangulated(distance: float) -> tuple[Float, Float]:
    """Points at ``distance`` in the left half, known to 1 %."""
    X = np.full((30, 40, 3), np.nan, np.float32)
    Q = np.zeros((30, 40), np.float32)
    X[:, :20] = distance * rays()[:, :20]
    Q[:, :20] = 1e4
    return X, Q


def learned(log_range: float, metric: bool, variance: float = 0.09) -> LearnedRange:
    shape = (3, 4)
    return LearnedRange(
        np.full(shape, log_range, np.float32), np.full(shape, variance, np.float32), metric
    )


@pytest.mark.parametrize(("metric", "distance"), [(False, 2.0), (True, 5.0)])
def test_both_halves_come_in_one_unit(metric: bool, distance: float) -> None:
    """The triangulation says 2, the network 5: whose unit counts depends on who knows metres."""
    X, Q = filled(*triangulated(2.0), CAMERA, learned(np.log(5.0), metric))
    np.testing.assert_allclose(np.linalg.norm(X, axis=-1), distance, rtol=1e-5)
    np.testing.assert_allclose(X, distance * rays(), rtol=1e-4, atol=1e-5)
    assert (Q[:, :20] == 1e4).all()
    np.testing.assert_allclose(Q[:, 20:], 1.0 / 0.09, rtol=1e-4)


def test_where_nothing_was_triangulated_the_network_stands_alone() -> None:
    X, Q = triangulated(2.0)
    X, Q = filled(np.full_like(X, np.nan), np.zeros_like(Q), CAMERA, learned(np.log(5.0), False))
    np.testing.assert_allclose(np.linalg.norm(X, axis=-1), 5.0, rtol=1e-5)
    assert (Q > 0.0).all()


def test_a_handful_of_points_sets_no_scale() -> None:
    X, Q = triangulated(2.0)
    Q[:, 1:] = 0.0
    Q[10:] = 0.0
    X, Q = filled(X, Q, CAMERA, learned(np.log(5.0), False))
    np.testing.assert_allclose(np.linalg.norm(X, axis=-1), 5.0, rtol=1e-5)


def test_no_network_knows_better_than_a_hundredth() -> None:
    _, Q = filled(*triangulated(2.0), CAMERA, learned(0.0, False, variance=0.0))
    assert Q[:, 20:].max() <= 1.01e4


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_nonsense_stays_a_number_and_costs_itself(bad: float) -> None:
    X, Q = filled(*triangulated(2.0), CAMERA, learned(bad, False, variance=bad))
    assert np.isfinite(X).all()
    assert np.isfinite(Q).all()
    np.testing.assert_allclose(X[:, :20], 2.0 * rays()[:, :20], rtol=1e-5)
