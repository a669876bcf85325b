"""The camera's own darkening of its picture."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.water.model import MAX_LOG_GAIN, TERMS, gain_map, shading_basis


def test_the_centre_of_the_picture_has_gain_one_whatever_the_coefficients() -> None:
    coefficients = np.array([0.3, -0.2, -0.5, 0.4, -0.1])
    gain = gain_map(coefficients, 31, 41)
    assert gain.shape == (31, 41)
    assert gain.dtype == np.float32
    assert gain[15, 20] == 1.0


def test_no_coefficients_mean_no_shading() -> None:
    assert (gain_map(np.zeros(TERMS), 6, 9) == 1.0).all()


def test_the_terms_are_x_y_and_their_products() -> None:
    basis = shading_basis(np.array([[0.5, -0.2], [0.0, 0.0]]))
    np.testing.assert_allclose(basis, [[0.5, -0.2, 0.25, -0.1, 0.04], [0.0] * 5])


def test_a_falling_term_darkens_the_side_it_belongs_to() -> None:
    right = gain_map(np.array([-0.5, 0, 0, 0, 0]), 10, 10)
    assert (np.diff(right, axis=1) < 0.0).all()
    assert (np.diff(right, axis=0) == 0.0).all()
    lower = gain_map(np.array([0, -0.5, 0, 0, 0]), 10, 10)
    assert (np.diff(lower, axis=0) < 0.0).all()


def test_pixels_are_taken_at_their_centres() -> None:
    gain = gain_map(np.array([1.0, 0, 0, 0, 0]), 1, 2)
    np.testing.assert_allclose(gain, np.exp([[-0.5, 0.5]]), rtol=1e-6)


@pytest.mark.parametrize("size", [1e3, -1e3])
def test_absurd_coefficients_are_bounded(size: float) -> None:
    gain = gain_map(np.full(TERMS, size), 20, 20)
    assert np.isfinite(gain).all()
    assert gain.min() >= np.exp(-MAX_LOG_GAIN) * 0.999
    assert gain.max() <= np.exp(MAX_LOG_GAIN) * 1.001
    assert gain.max() / gain.min() > np.exp(MAX_LOG_GAIN)
