"""A map from the second picture on, where a prior's ranges are certain enough."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from aquaflow.config import TrackingConfig
from aquaflow.config.tracking import LearnedConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.tracking.map_start import learned_start
from tests.tracking.tracked_clips import PLACED, SMALL, error_share, plane_depth, run
from tests.tracking.tracking_scenes import KnownPair, KnownPrior, KnownView, pose

STARTING = TrackingConfig(learned=LearnedConfig(start=True))
STILL = pose((0.001, 0.002, -0.001), (0.004, 0.001, 0.0))
"""A step of 0.3 % of the depth: a quarter of a pixel."""


class RangedPair(KnownPair):
    """A pair whose pictures' ranges are known to ``sigma``, and stated to ``stated``."""

    def __init__(self, a: KnownView, b: KnownView, sigma: float, stated: float) -> None:
        super().__init__(a, b, 0.05, SMALL)
        self.X_a, self.Q_a = _ranged(a, sigma, stated)
        self.X_b, self.Q_b = _ranged(b, sigma, stated)


def _ranged(view: KnownView, sigma: float, stated: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(int(1e6 * abs(view.T_wc.t).sum()))
    z = 7.0 * view.depth * np.exp(sigma * rng.normal(size=view.depth.shape))
    X = SMALL.unproject(SMALL.pixel_centres()) * z[..., None]
    return X.astype(np.float32), np.full(z.shape, stated**-2, np.float32)


class RangedPrior(KnownPrior):
    """A prior that knows poses and ranges."""

    ranged = True

    def __init__(self, poses: Sequence[Sim3], sigma: float = 0.05) -> None:
        super().__init__([KnownView(SMALL, T, plane_depth(T)) for T in poses], SMALL)
        self.sigma = sigma

    def decode(self, a, b, predicted=None, alone=False):  # type: ignore[no-untyped-def]
        return RangedPair(a, b, self.sigma, self.sigma)


class AffinePrior(RangedPrior):
    """A prior that knows poses, and inverse depths up to a scale and shift of each picture."""

    def decode(self, a, b, predicted=None, alone=False):  # type: ignore[no-untyped-def]
        found = RangedPair(a, b, self.sigma, self.sigma)
        found.range_unit = "affine"
        found.X_a = found.X_a / (1.0 + 0.05 * found.X_a[..., 2:])  # 1 / z becomes 1 / z + 0.05
        found.X_b = found.X_b / (1.0 + 0.15 * found.X_b[..., 2:])
        return found


def pair(sigma: float = 0.05, stated: float = 0.05, T_ba: Sim3 = STILL) -> RangedPair:
    first, T_wc = Sim3.identity(), T_ba.inverse()
    return RangedPair(
        KnownView(SMALL, first, plane_depth(first)),
        KnownView(SMALL, T_wc, plane_depth(T_wc)),
        sigma,
        stated,
    )


def test_two_pictures_without_parallax_give_a_map() -> None:
    start = learned_start(pair(), SMALL, STARTING)
    assert start is not None
    assert not start.pointmap.is_known(1.0).any(), "nothing is triangulated yet"
    depth = 1.0 / start.pointmap.complete(1.0).rho
    assert np.median(depth) == pytest.approx(1.0)
    truth = plane_depth(Sim3.identity())
    ratio = depth / truth
    assert np.median(np.abs(np.log(ratio / np.median(ratio)))) < 0.05
    step = STILL.t * np.median(ratio)
    assert np.linalg.norm(start.T_fk.t - step) < 0.5 * np.linalg.norm(step)


@pytest.mark.parametrize(
    ("sigma", "stated"),
    [
        pytest.param(0.2, 0.2, id="it says that it knows too little"),
        pytest.param(0.4, 0.05, id="it says that it knows what it does not"),
    ],
)
def test_ranges_that_are_not_certain_enough_start_no_map(sigma: float, stated: float) -> None:
    assert learned_start(pair(sigma, stated), SMALL, STARTING) is None


def test_matches_that_no_motion_explains_start_no_map() -> None:
    wrong = pair()
    wrong.matches = wrong.matches[::-1, ::-1].copy()
    assert learned_start(wrong, SMALL, STARTING) is None


def test_no_map_starts_from_ranges_where_that_is_not_wanted() -> None:
    assert learned_start(pair(), SMALL, TrackingConfig()) is None


def test_a_prior_without_ranges_starts_no_map() -> None:
    plain = pair()
    plain.X_b = None
    assert learned_start(plain, SMALL, STARTING) is None


def test_ranges_that_are_known_up_to_a_shift_start_no_map() -> None:
    affine = pair()
    affine.range_unit = "affine"
    assert learned_start(affine, SMALL, STARTING) is None


def test_a_still_camera_has_poses_from_the_first_picture_on() -> None:
    """Then it moves, and triangulation takes over."""
    still = [pose((0.0, 0.0, 0.0), (0.0003 * i, 0.0, 0.0)) for i in range(6)]
    swim = [
        pose((0.01 * i, 0.02 * i, -0.03 * i), (0.05 * i, 0.06 * np.sin(0.9 * i), 0.02 * i))
        for i in range(1, 12)
    ]
    poses = [*still, *swim]
    prior = RangedPrior(poses)
    tracked = run(prior.frames(SMALL), prior=prior, config=STARTING)
    assert all(each.frame_class in PLACED for each in tracked.tracked)
    assert tracked.tracked[0].frame.index == 0
    assert tracked.store[0].frame_index == 0
    assert error_share(tracked.tracked, poses) < 0.02
    assert tracked.store[0].pointmap.is_known(0.15).mean() > 0.5, (
        "most of it is triangulated by then"
    )


def test_ranges_up_to_a_shift_fill_the_map_once_something_is_triangulated() -> None:
    poses = [
        pose((0.01 * i, 0.02 * i, -0.03 * i), (0.05 * i, 0.06 * np.sin(0.9 * i), 0.02 * i))
        for i in range(12)
    ]
    prior = AffinePrior(poses, 0.02)
    tracked = run(prior.frames(SMALL), prior=prior)
    assert all(each.frame_class in PLACED for each in tracked.tracked)
    assert error_share(tracked.tracked, poses) < 0.02
    first = tracked.store[0].pointmap
    assert first.learned is not None
    depth = plane_depth(Sim3.identity())
    known, learned = first.is_known(0.15), first.learned.rho > 0.0
    ratio = np.median((first.learned.rho * depth)[learned]) / np.median((first.rho * depth)[known])
    assert abs(np.log(ratio)) < 0.05
