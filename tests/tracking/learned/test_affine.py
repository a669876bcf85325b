"""Inverse depths that a network knows up to scale and shift become depths of the keyframe."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import RangeUnit
from aquaflow.tracking.learned import (
    FARTHEST,
    LearnedDepth,
    learned_depth,
    shift_of,
    shifted_depth,
)
from aquaflow.tracking.pose.matcher import own_points
from tests.tracking.learned.learned_scenes import KNOWN_SIGMA, TRUTH, affine_network, measured
from tests.tracking.tracking_scenes import CAMERA, Array, KnownPair, KnownView

RIGHT = np.s_[:, CAMERA.width // 2 :]


def log_error(found: LearnedDepth | None) -> Array:
    """[H, W / 2] where nothing was triangulated."""
    assert found is not None
    return np.asarray(np.log(found.rho * TRUTH)[RIGHT])


@pytest.mark.parametrize("scale", [0.01, 3.0, 500.0])
@pytest.mark.parametrize("shift", [-0.2, 0.0, 0.3, 2.0])
def test_scale_and_shift_are_found_whatever_they_are(scale: float, shift: float) -> None:
    found = learned_depth(measured(), *affine_network(scale, shift), KNOWN_SIGMA, "affine")
    assert np.median(np.abs(log_error(found))) < 0.05


def test_without_the_shift_the_same_range_is_wrong() -> None:
    """So that the test above shows something."""
    found = learned_depth(measured(), *affine_network(shift=2.0), KNOWN_SIGMA)
    assert np.median(np.abs(log_error(found))) > 0.1


@pytest.mark.parametrize("stated", [0.03, 0.05, 0.08])
def test_the_error_is_the_one_that_was_found_and_not_the_one_stated(stated: float) -> None:
    normalised = []
    for seed in range(8):
        range_ = affine_network(stated=stated, seed=seed)
        found = learned_depth(measured(), *range_, KNOWN_SIGMA, "affine")
        error = log_error(found)
        assert found is not None
        normalised.append((error**2 / found.variance[RIGHT]).mean())
    assert 0.64 < np.mean(normalised) < 1.56


def test_a_third_of_false_depths_moves_neither_scale_nor_shift() -> None:
    pointmap = measured()
    pointmap.rho[::3, : CAMERA.width // 2] *= 3.0
    pointmap.variance[::3, : CAMERA.width // 2] *= 9.0
    found = learned_depth(pointmap, *affine_network(), KNOWN_SIGMA, "affine")
    assert np.median(np.abs(log_error(found))) < 0.06


def test_a_network_that_takes_near_for_far_is_not_used() -> None:
    X, Q = affine_network()
    z = 1.0 / (2.0 - 1.0 / TRUTH)  # its inverse depth falls where the true one grows
    X = (X / X[..., 2:] * z[..., None]).astype(np.float32)
    assert learned_depth(measured(), X, Q, KNOWN_SIGMA, "affine") is None


def test_of_one_depth_everywhere_no_shift_is_found() -> None:
    assert shift_of(np.ones(500), np.linspace(0.5, 1.0, 500)) is None


@pytest.mark.parametrize("spread", [0.03, 0.1, 0.3, 0.6])
def test_a_common_part_of_nearly_one_depth_gives_no_false_certainty(spread: float) -> None:
    """Scale and shift cannot be told apart there: unknown, or as uncertain as they then are."""
    normalised = []
    for seed in range(6):
        near = measured(share=1.0)
        near.rho[np.abs(TRUTH - 1.9) > spread] = 0.0
        found = learned_depth(near, *affine_network(seed=seed), KNOWN_SIGMA, "affine")
        if found is not None:
            other = found.known & (np.abs(TRUTH - 1.9) > spread)
            error = np.log(found.rho * TRUTH)[other]
            normalised.append((error**2 / found.variance[other]).mean())
    assert not normalised or np.mean(normalised) < 2.5


def test_without_triangulated_pixels_the_range_is_unknown() -> None:
    pointmap = Pointmap.unknown(CAMERA)
    assert learned_depth(pointmap, *affine_network(), KNOWN_SIGMA, "affine") is None


def test_what_the_shift_puts_at_infinity_is_unknown() -> None:
    z = np.array([[1.0, 1.0, 1.0, 2.0, 2.0 * FARTHEST, np.nan]])
    moved = shifted_depth(z, -0.5)
    np.testing.assert_array_equal(np.isfinite(moved), [[True, True, True, False, False, False]])
    assert np.isnan(shifted_depth(z, -2.0)).all()


@pytest.mark.parametrize("unit", ["own", "affine"])
def test_pictures_without_a_common_unit_give_no_points_of_the_frame(unit: RangeUnit) -> None:
    view = KnownView(CAMERA, Sim3.identity(), TRUTH)
    pair = KnownPair(view, view, 0.0, CAMERA)
    pair.X_a, pair.Q_a = pair.X_b, pair.Q_b = affine_network()
    pixels = np.full((3, 2), 50.5)
    pair.range_unit = "shared"
    assert own_points(measured(), pair, pixels, CAMERA, KNOWN_SIGMA) is not None
    pair.range_unit = unit
    assert own_points(measured(), pair, pixels, CAMERA, KNOWN_SIGMA) is None
