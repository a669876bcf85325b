"""What a browser gets of a map: the few that matter, most first, nothing that is not finite."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.survey.viewer.splats import ViewerSplats, covariances, splats

RNG = np.random.default_rng(0)


def some(count: int, budget: int, spoiled: int | None = None) -> ViewerSplats:
    means = RNG.normal(size=(count, 3)).astype(np.float32)
    quats = RNG.normal(size=(count, 4)).astype(np.float32)
    scales = np.full((count, 3), 0.1, np.float32)
    opacities = np.linspace(0.01, 0.99, count).astype(np.float32)
    if spoiled is not None:
        means[spoiled] = np.nan
    colours = np.repeat(opacities[:, None], 3, axis=1)
    return splats(means, quats, scales, opacities, colours, budget)


def test_covariances_are_those_of_rotated_axes() -> None:
    quats, scales = RNG.normal(size=(20, 4)), RNG.uniform(0.1, 2.0, (20, 3))
    R = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    expected = R @ (np.eye(3) * (scales**2)[:, None]) @ R.transpose(0, 2, 1)
    assert np.allclose(covariances(quats, scales), expected, atol=1e-5)


def test_a_map_within_the_budget_keeps_its_sizes() -> None:
    shown = some(50, budget=50)
    assert len(shown) == 50
    assert np.allclose(shown.scales, 0.1, rtol=1e-6)
    assert np.allclose(np.linalg.norm(shown.wxyz, axis=1), 1.0, atol=1e-6)


def test_of_a_larger_map_those_that_cover_most_are_shown_and_a_little_larger() -> None:
    shown = some(100, budget=40)
    assert len(shown) == 40
    assert shown.opacities.min() > 0.55
    assert 0.1 < shown.scales.mean() < 0.15


def test_those_that_cover_most_come_first() -> None:
    weights = some(300, budget=300).weights()
    assert (np.diff(weights) <= 0.0).all()
    assert weights[0] > weights[-1]


def test_levels_stay_with_their_gaussians() -> None:
    opacities = np.array([0.2, 0.9, 0.5], np.float32)
    shown = splats(
        np.zeros((3, 3), np.float32), np.ones((3, 4), np.float32), np.ones((3, 3), np.float32),
        opacities, np.zeros((3, 3), np.float32), 2, {"seen": np.array([2, 9, 5], np.uint8)},
    )  # fmt: skip
    assert shown.levels["seen"].tolist() == [9, 5]


def test_what_is_not_finite_is_left_out() -> None:
    assert len(some(50, budget=100, spoiled=7)) == 49
    assert np.isfinite(some(50, budget=20, spoiled=49).centres).all()
