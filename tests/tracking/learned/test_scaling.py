"""A learned range finds its unit and its true error where depths are triangulated."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.keyframes import Pointmap
from aquaflow.tracking.learned import (
    HONESTY,
    LEAST_COMMON,
    agreement,
    learned_depth,
    unscaled_depth,
)
from tests.tracking.learned.learned_scenes import KNOWN_SIGMA, TRUTH, measured, network
from tests.tracking.tracking_scenes import CAMERA, Array


def log_error(rho: Array) -> Array:
    return np.asarray(np.log(rho * TRUTH))


@pytest.mark.parametrize("unit", [0.01, 1.0, 3.0, 250.0])
def test_the_unit_is_found_whatever_it_is(unit: float) -> None:
    found = learned_depth(measured(), *network(unit), KNOWN_SIGMA)
    assert found is not None
    assert found.log_scale == pytest.approx(-np.log(unit), abs=0.03)
    assert np.median(np.abs(log_error(found.rho))) < 0.06


def test_a_slope_that_the_network_did_not_see_is_found() -> None:
    found = learned_depth(measured(), *network(slope=0.15), KNOWN_SIGMA)
    assert found is not None
    right = log_error(found.rho)[:, CAMERA.width // 2 :]
    assert abs(right.mean()) < 0.08  # 0.15 from the middle to the edge, without


@pytest.mark.parametrize("stated", [0.02, 0.05, 0.1])
def test_the_error_is_the_one_that_was_found_and_not_the_one_stated(stated: float) -> None:
    normalised = []
    for seed in range(8):
        found = learned_depth(measured(), *network(stated=stated, seed=seed), KNOWN_SIGMA)
        assert found is not None
        right = np.s_[:, CAMERA.width // 2 :]
        normalised.append((log_error(found.rho)[right] ** 2 / found.variance[right]).mean())
    assert 0.64 < np.mean(normalised) < 1.56  # the 0.8 to 1.25, squared


@pytest.mark.parametrize("stated", [1e-7, 1e-3, 30.0])
def test_an_error_that_is_stated_far_too_small_or_large_costs_nothing(stated: float) -> None:
    found = learned_depth(measured(), *network(stated=stated), KNOWN_SIGMA)
    assert found is not None
    assert found.log_scale == pytest.approx(-np.log(3.0), abs=0.05)
    assert np.isfinite(found.variance[found.known]).all()
    assert np.median(found.variance[found.known]) > 0.03**2


def test_a_third_of_false_depths_does_not_move_the_unit() -> None:
    pointmap = measured()
    pointmap.rho[::3, : CAMERA.width // 2] *= 3.0
    pointmap.variance[::3, : CAMERA.width // 2] *= 9.0
    found = learned_depth(pointmap, *network(), KNOWN_SIGMA)
    assert found is not None
    assert found.log_scale == pytest.approx(-np.log(3.0), abs=0.06)


def test_too_few_common_pixels_give_no_unit() -> None:
    pointmap = Pointmap.unknown(CAMERA)
    pointmap.rho[0, : LEAST_COMMON - 1] = 1.0
    pointmap.variance[0, : LEAST_COMMON - 1] = 1e-4
    assert learned_depth(pointmap, *network(), KNOWN_SIGMA) is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, 0.0])
def test_pixels_without_a_sound_point_stay_unknown(bad: float) -> None:
    X, Q = network()
    X[10:20] = bad
    found = learned_depth(measured(), X, Q, KNOWN_SIGMA)
    assert found is not None
    assert not found.known[10:20].any()
    assert np.isfinite(found.rho).all()
    assert np.isfinite(found.variance[found.known]).all()


def test_alone_its_median_depth_is_one() -> None:
    found = unscaled_depth(CAMERA, *network())
    assert found is not None
    assert np.median(1.0 / found.rho) == pytest.approx(1.0)


def test_alone_it_needs_points() -> None:
    X, Q = network()
    assert unscaled_depth(CAMERA, X, np.zeros_like(Q)) is None


def test_two_pictures_that_contradict_each_other_are_found_out() -> None:
    """What each states is 5 %; of two independent pictures that is honest only if it is true."""
    v, u = np.mgrid[: CAMERA.height : 2, : CAMERA.width : 2]
    pixels = np.stack([u.ravel() + 0.5, v.ravel() + 0.5], -1)
    found = []
    for sigma in (0.05, 0.25):
        a, b = (unscaled_depth(CAMERA, *network(sigma=sigma, seed=seed)) for seed in (1, 2))
        assert a is not None
        assert b is not None
        z = 1.0 / a.rho[v.ravel(), u.ravel()]
        found.append(agreement(a, b, z, pixels, pixels))
    assert found[0] == pytest.approx(1.0, abs=0.1)
    assert found[1] == pytest.approx(5.0, abs=0.5)
    assert agreement(a, b, z[:10], pixels[:10], pixels[:10]) == HONESTY[1]
