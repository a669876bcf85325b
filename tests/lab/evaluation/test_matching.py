"""Recall under homographies: the truth is true, and matchers get what they deserve."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.lab.evaluation.matching import (
    HEIGHT,
    LEVELS,
    WIDTH,
    Distortion,
    homography_pair,
    homography_recall,
    matcher_of,
    relit,
)
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.flow import pixel_grid

Picture = npt.NDArray[np.uint8]
STILL = Distortion.scale("still", 0.0)
MILD = LEVELS[0]


def textured(seed: int = 0) -> Picture:
    rng = np.random.default_rng(seed)
    total = np.zeros((360, 480, 3))
    for sigma in (1.5, 4.0, 10.0):
        layer = cv2.GaussianBlur(rng.normal(size=total.shape), (0, 0), sigma)
        total += layer / layer.std()
    return np.clip(127.0 + 30.0 * total, 0, 255).astype(np.uint8)


def test_a_picture_that_stays_matches_itself() -> None:
    pair = homography_pair(textured(), STILL, np.random.default_rng(0))
    np.testing.assert_allclose(pair.truth, pixel_grid(HEIGHT, WIDTH), atol=1e-3)
    assert pair.inside[5:-5, 5:-5].all()


def test_the_truth_leads_to_the_same_point_of_the_picture() -> None:
    pair = homography_pair(textured(), LEVELS[1], np.random.default_rng(3))
    xy = pair.truth - 0.5
    warped = cv2.remap(pair.b, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR)

    def alike(shift: int) -> float:
        """Correlation with a, moved by ``shift`` px."""
        there = np.roll(warped, shift, axis=1)[pair.inside].astype(float).ravel()
        return float(np.corrcoef(pair.a[pair.inside].astype(float).ravel(), there)[0, 1])

    assert alike(0) > 0.8
    assert alike(0) > max(alike(1), alike(-1)) + 0.02


def test_a_perfect_matcher_finds_all_and_a_lazy_one_little() -> None:
    pictures = [textured()]
    rng = np.random.default_rng(5)
    rng.integers(1)
    truth = homography_pair(pictures[0], LEVELS[1], rng).truth
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    perfect = homography_recall(lambda a, b: (truth, everywhere), pictures, LEVELS[1], 1, seed=5)
    assert perfect == {"recall": 1.0, "kept": 1.0, "precision": 1.0}
    grid = pixel_grid(HEIGHT, WIDTH)
    lazy = homography_recall(lambda a, b: (grid, ~everywhere), pictures, LEVELS[1], 1, seed=5)
    assert lazy["recall"] < 0.2
    assert lazy["kept"] == lazy["precision"] == 0.0


def test_levels_go_as_far_as_they_say() -> None:
    medium, hard = LEVELS[1:]
    assert (medium.turn_deg, medium.shift_px[0]) == (20.0, 45.0)
    assert (hard.turn_deg, hard.shift_px[0]) == pytest.approx((32.0, 72.0))


def test_relit_pictures_differ_from_each_other_and_repeat() -> None:
    one, same, other = (relit(textured(), np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert np.abs(one.astype(int) - other).mean() > 5.0


def test_a_prior_finds_mild_changes() -> None:
    found = homography_recall(matcher_of(ClassicalPrior()), [textured()], MILD, 1, seed=1)
    assert found["recall"] > 0.95
    assert found["precision"] > 0.95
