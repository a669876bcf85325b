"""What a browser gets of a map: covariances, the few that matter, nothing that is not finite."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.viewer.splats import Splats, covariances, heat, splats

RNG = np.random.default_rng(0)


def some(count: int, budget: int, spoiled: int | None = None) -> Splats:
    means = RNG.normal(size=(count, 3)).astype(np.float32)
    quats = RNG.normal(size=(count, 4)).astype(np.float32)
    scales = np.full((count, 3), 0.1, np.float32)
    opacities = np.linspace(0.01, 0.99, count).astype(np.float32)
    if spoiled is not None:
        means[spoiled] = np.nan
    colours = {"water": np.repeat(opacities[:, None], 3, axis=1)}
    return splats(means, quats, scales, opacities, colours, budget)


def test_covariances_are_those_of_rotated_axes() -> None:
    quats, scales = RNG.normal(size=(20, 4)), RNG.uniform(0.1, 2.0, (20, 3))
    R = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    expected = R @ (np.eye(3) * (scales**2)[:, None]) @ R.transpose(0, 2, 1)
    assert np.allclose(covariances(quats, scales), expected, atol=1e-5)


def test_a_map_within_the_budget_is_shown_as_it_is() -> None:
    shown = some(50, budget=50)
    assert len(shown) == 50
    assert np.allclose(np.linalg.det(shown.covariances), 0.1**6, rtol=1e-3)


def test_of_a_larger_map_the_most_opaque_are_shown_and_a_little_larger() -> None:
    shown = some(100, budget=40)
    assert len(shown) == 40
    assert shown.opacities.min() > 0.55
    assert 0.1**6 < np.linalg.det(shown.covariances).mean() < 8 * 0.1**6


def test_what_is_not_finite_is_left_out() -> None:
    assert len(some(50, budget=100, spoiled=7)) == 49
    assert np.isfinite(some(50, budget=20, spoiled=49).centres).all()


def test_heat_goes_from_dark_to_light_and_stands_any_number() -> None:
    colours = heat(np.array([0.0, 0.5, 1.0, np.nan, 7.0]))
    brightness = colours.mean(axis=1)
    assert brightness[0] < brightness[1] < brightness[2]
    assert np.isfinite(colours).all()
