"""Learned ranges of cells become a pointmap with a confidence; nonsense stays unknown."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.network import LearnedRange

CAMERA = CameraModel(40, 30, 40.0, 40.0, 20.0, 15.0)


def rays() -> npt.NDArray[np.float64]:
    """[30, 40, 3] of length 1."""
    found = CAMERA.unproject(CAMERA.pixel_centres())
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def learned(log_range: float, variance: float = 0.09) -> LearnedRange:
    shape = (3, 4)
    return LearnedRange(np.full(shape, log_range, np.float32), np.full(shape, variance, np.float32))


def test_points_lie_on_their_pixels_rays_at_the_range() -> None:
    X, Q = learned(np.log(5.0)).pointmap(CAMERA)
    np.testing.assert_allclose(X, 5.0 * rays(), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(Q, 1.0 / 0.09, rtol=1e-4)


def test_no_network_knows_better_than_a_hundredth() -> None:
    _, Q = learned(0.0, variance=1e-12).pointmap(CAMERA)
    np.testing.assert_allclose(Q, 1e4, rtol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("which", ["log_range", "variance"])
def test_a_cell_without_a_sound_number_is_unknown_and_costs_itself(bad: float, which: str) -> None:
    range_ = learned(np.log(5.0))
    values = getattr(range_, which)
    values[1, 2] = bad
    X, Q = range_.pointmap(CAMERA)
    known = np.isfinite(X).all(-1)
    if which == "variance" and bad == 1e30:
        assert known.all()
        assert Q[15, 25] < 1e-6
        return
    assert not known[15, 25]
    assert Q[15, 25] == 0.0
    np.testing.assert_allclose(X[known], 5.0 * rays()[known], rtol=1e-4)
    assert known[:5].all()
