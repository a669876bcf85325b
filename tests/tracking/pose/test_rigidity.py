"""Matches of one rigid scene are told from matches onto what floats in front of it."""

from __future__ import annotations

import numpy as np

from aquaflow.tracking.consistency import rigid_share
from tests.tracking.tracked_clips import SMALL, plane_depth
from tests.tracking.tracking_scenes import KnownPair, KnownView, pose

HERE, THERE = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), pose((0.02, 0.05, 0.1), (0.3, 0.1, 0.05))


def pair() -> KnownPair:
    views = [KnownView(SMALL, T, plane_depth(T)) for T in (HERE, THERE)]
    return KnownPair(*views, 0.05, SMALL)


def test_true_matches_are_those_of_a_rigid_scene() -> None:
    assert rigid_share(pair(), SMALL, SMALL) > 0.95


def test_displaced_matches_are_not() -> None:
    spoiled, rng = pair(), np.random.default_rng(0)
    spoiled.matches += rng.normal(0.0, 4.0, spoiled.matches.shape).astype(np.float32)
    assert rigid_share(spoiled, SMALL, SMALL) < 0.5


def test_no_match_shows_nothing() -> None:
    nothing = pair()
    nothing.valid = np.zeros_like(nothing.valid)
    assert rigid_share(nothing, SMALL, SMALL) == 0.0
