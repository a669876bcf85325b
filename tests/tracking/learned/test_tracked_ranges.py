"""X, Q and C decide poses and depths of a tracked clip: noise in their place changes results."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from tests.tracking.tracked_clips import SMALL, Run, path, plane_depth, run
from tests.tracking.tracking_scenes import KnownPair, KnownPrior, KnownView

POSES = path(14)


class Ranged(KnownPrior):
    """Knows poses and ranges to 5 %; what ``spoilt`` names is noise."""

    ranged = True

    def __init__(self, poses: Sequence[Sim3], spoilt: str = "") -> None:
        super().__init__([KnownView(SMALL, T, plane_depth(T)) for T in poses], SMALL)
        self.spoilt = spoilt

    def decode(self, a, b, predicted=None, alone=False):  # type: ignore[no-untyped-def]
        pair, rng = KnownPair(a, b, 0.2, SMALL), np.random.default_rng(1)
        half = np.arange(SMALL.width) < SMALL.width // 2
        pair.valid = pair.valid & half  # the right half has no matches
        pair.C = pair.valid * np.linspace(0.2, 1.0, SMALL.width, dtype=np.float32)
        for name, view in (("a", a), ("b", b)):
            z = 3.0 * view.depth * np.exp(0.05 * rng.normal(size=view.depth.shape))
            X = (SMALL.unproject(SMALL.pixel_centres()) * z[..., None]).astype(np.float32)
            Q = np.full(z.shape, 400.0, np.float32)
            if self.spoilt == "X":
                X = rng.uniform(0.1, 10.0, X.shape).astype(np.float32)
            if self.spoilt == "Q":
                Q = np.exp(rng.normal(6.0, 4.0, Q.shape)).astype(np.float32)
            setattr(pair, f"X_{name}", X)
            setattr(pair, f"Q_{name}", Q)
        if self.spoilt == "C":
            pair.C = pair.valid * rng.uniform(0.01, 1.0, pair.C.shape).astype(np.float32)
        return pair


def tracked(spoilt: str = "") -> Run:
    prior = Ranged(POSES, spoilt)
    return run(prior.frames(SMALL), prior=prior)


@pytest.fixture(scope="module")
def whole() -> Run:
    return tracked()


def test_half_a_picture_without_matches_has_learned_depths(whole: Run) -> None:
    pointmap = whole.store[0].pointmap
    right = np.s_[:, SMALL.width // 2 + 4 :]
    assert not pointmap.is_known(0.15)[right].any()
    pointmap = pointmap.complete(0.15)
    assert pointmap.is_known(0.15)[right].mean() > 0.9
    truth = plane_depth(POSES[whole.store[0].frame_index])
    ratio = (1.0 / pointmap.rho / truth)[pointmap.rho > 0.0]
    assert np.median(np.abs(np.log(ratio / np.median(ratio)))) < 0.06


@pytest.mark.parametrize("spoilt", ["X", "Q", "C"])
def test_noise_in_place_of_an_output_changes_poses_or_depths(whole: Run, spoilt: str) -> None:
    other = tracked(spoilt)
    poses = [
        np.array([T.t for each in found.tracked if (T := each.T_wc) is not None])
        for found in (whole, other)
    ]
    same_poses = poses[0].shape == poses[1].shape and np.array_equal(*poses)
    depths = [found.store[0].pointmap.complete(0.15).rho for found in (whole, other)]
    assert not (same_poses and np.array_equal(*depths))
