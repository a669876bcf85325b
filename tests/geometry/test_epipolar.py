"""Distances from epipolar lines: zero for true matches, the noise's size for noisy ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.geometry.two_view import epipolar_distances


def two_views(seed: int, count: int = 400) -> tuple[np.ndarray, np.ndarray, Sim3]:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(2, 5, count)])
    T_ba = Sim3(so3_exp(rng.normal(size=3) * 0.1), rng.normal(size=3) * 0.3)
    seen = T_ba.apply(points)
    return points / points[:, 2:], seen / seen[:, 2:], T_ba


@given(st.integers(0, 2**31), st.floats(0.01, 100.0))
def test_true_matches_lie_on_their_lines_whatever_the_scale(seed: int, scale: float) -> None:
    a, b, T = two_views(seed, 20)

    distances = epipolar_distances(a, b, Sim3(T.R, scale * T.t, 1.0))

    assert distances.max() < 1e-9


def test_distances_are_as_large_as_the_noise_of_both_points() -> None:
    a, b, T = two_views(3)
    rng = np.random.default_rng(0)
    for rays in (a, b):
        rays[:, :2] += 0.001 * rng.normal(size=(len(rays), 2))

    # One direction of four is measured: the distance is a normal error's absolute value.
    assert np.sqrt((epipolar_distances(a, b, T) ** 2).mean()) == pytest.approx(0.001, rel=0.1)


def test_a_camera_that_only_turned_gives_finite_distances() -> None:
    a, _, T = two_views(4)
    turned = a @ T.R.T

    assert np.isfinite(epipolar_distances(a, turned / turned[:, 2:], Sim3(T.R, np.zeros(3)))).all()
