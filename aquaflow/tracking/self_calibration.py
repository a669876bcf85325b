"""Self-calibration: focal length and first radial distortion of a camera without
calibration.

The guess that a dive begins with is treated as a calibration with an error of its lens, which a
bundle adjustment over keypoint matches of many views finds. What the motion does not determine
stays as it was guessed, and its standard deviation says so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import TERMS
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Keypoints
from aquaflow.tracking.lens_equations import (
    Array,
    LensAdjustment,
    LensObservations,
    LensView,
    adjust_lens,
    model_error,
    solve_matched,
)

MIN_VIEWS = 6
"""With fewer, the scatter between the views is no estimate."""
STEPS = (1, 2, 3, 5, 8, 13, 21)
"""From one view to those that it is matched with: neighbours are matched surely, and distant ones
show the focal length, which is a matter of wide angles."""
SYSTEMATIC = np.array([10.0, 5.0])
"""Standard deviations of log focal length and k1, over the noise of the matches (normalised units),
that no scatter between views shows: keypoints are pulled along edges and by the pixels' grid the
same way everywhere. Measured on synthetic dives (notes/2026-11-tracking.md#self-calibration)."""
KNOWN_SIGMA = 0.1
"""Of the log focal length; above, the dive hardly says more than the guess."""


@dataclass(frozen=True)
class FoundLens:
    """The lens of a camera without calibration, as its own pictures show it."""

    lens: Array
    """[5] error of the guess, as in ``geometry.lens_error``; the last three are 0."""
    sigma: Array
    """[2] standard deviations of the log focal length and of k1."""
    noise: float
    """Of the matches, normalised units."""
    views: int
    matches: int

    @property
    def known(self) -> bool:
        """Whether the motion determines the focal length."""
        return bool(self.sigma[0] < KNOWN_SIGMA)

    def camera(self, guess: CameraModel) -> CameraModel:
        """The calibration; of a focal length that is not known, the guess is what it is."""
        scaled = guess.with_focal_scaled(float(np.exp(self.lens[0])))
        distortion = (float(self.lens[1]), 0.0, 0.0, 0.0)
        return replace(scaled, distortion_model="radtan", distortion=distortion, calibrated=True)


def found_lens(
    views: Sequence[LensView],
    start: Array | None = None,  # [5] lens error that the poses of the views go with, 0 if None
) -> FoundLens | None:
    """The lens that ``views`` of one guessed camera show; None if they are too few."""
    if len(views) < MIN_VIEWS:
        return None
    return solve_matched(views, pairs_of(len(views)), partial(estimate, start=start))


def pairs_of(views: int) -> list[tuple[int, int]]:
    """Views that are matched with each other."""
    return [(i, i + step) for i in range(views) for step in STEPS if i + step < views]


def estimate(
    observations: LensObservations,
    R_wc: Array,  # [V, 3, 3]
    centres: Array,  # [V, 3]
    start: Array | None = None,  # [5]
) -> FoundLens:
    """The lens from poses that are roughly right.

    Raises:
        numpy.linalg.LinAlgError: the matches determine nothing at all.
    """
    simple = adjust_lens(observations, R_wc, centres, 2, start)
    state = simple.adjusted
    full = adjust_lens(observations, state.R_wc, state.centres, TERMS, state.lens)
    if model_error(simple, full)[0, 0] > simple.covariance[0, 0]:
        # The further terms describe the lens, or they led out of a local minimum.
        state, lens = full.adjusted, np.where(np.arange(TERMS) < 2, full.adjusted.lens, 0.0)
        again = adjust_lens(observations, state.R_wc, state.centres, 2, lens)
        simple = min(simple, again, key=lambda each: each.sigma)
    shared = np.diag((SYSTEMATIC * simple.sigma) ** 2)
    covariance = simple.covariance + model_error(simple, full) + shared
    if not np.isfinite(covariance).all():
        raise np.linalg.LinAlgError("the matches determine no lens")
    return _found_lens_of(simple, covariance, observations)


def _found_lens_of(
    simple: LensAdjustment,
    covariance: Array,  # [2, 2]
    observations: LensObservations,
) -> FoundLens:
    sigma, state = np.sqrt(np.diag(covariance)), simple.adjusted
    views, matches = len(state.R_wc), len(observations.matches)
    return FoundLens(state.lens, sigma, simple.sigma, views, matches)


# --------------------------------------------------------------------------------------------------
# Which pictures of a dive show its lens: a bounded number, evenly spread over the motion.

MOST_VIEWS = 32
"""At once: the adjustment of as many takes a few seconds."""
FIRST_SPACING = 0.01
"""Motion from one view to the next, picture widths; doubled when there are too many views."""
LAST_SPACING = 0.16
"""With a third of the picture's height, the views three further on still show the same."""


@dataclass(frozen=True)
class _Candidate:
    frame_index: int
    keypoints: Keypoints
    sub_map: int


class LensViews:
    """Views of one camera in the order of the dive; where too many came, every other one is left
    out and the next ones come half as often."""

    def __init__(self, guess: CameraModel) -> None:
        self._guess, self._spacing = guess, FIRST_SPACING
        self._views: list[_Candidate] = []
        self._last: tuple[Sim3, int] | None = None

    def offer(
        self,
        frame_index: int,
        T_wc: Sim3,
        sub_map: int,
        rho: float,
        keypoints: Callable[[], Keypoints],
    ) -> None:
        """Take the picture as a view if the camera has moved far enough since the last one.

        ``rho``: median inverse depth of what it sees, 1 / world units.
        """
        if self._last is not None and self._last[1] == sub_map:
            moved = motion(self._last[0], T_wc, rho) * self._guess.fx / self._guess.width
            if moved < self._spacing:
                return
        self._last = (T_wc, sub_map)
        self._views.append(_Candidate(frame_index, keypoints(), sub_map))

    @property
    def full(self) -> bool:
        """True if :meth:`thin` should make room."""
        return len(self._views) >= MOST_VIEWS

    @property
    def complete(self) -> bool:
        """True if views further apart would no longer show the same."""
        return self.full and self._spacing >= LAST_SPACING

    def thin(self) -> None:
        """Leave out every other view."""
        self._views, self._spacing = self._views[::2], 2.0 * self._spacing

    def posed_views(self, poses: Mapping[int, Sim3]) -> list[LensView]:
        """Those of the sub-map with most views, with the poses by frame index."""
        seen = [view for view in self._views if view.frame_index in poses]
        if not seen:
            return []
        [(largest, _)] = Counter(view.sub_map for view in seen).most_common(1)
        return [
            LensView(view.keypoints, self._guess, poses[view.frame_index])
            for view in seen
            if view.sub_map == largest
        ]


def motion(before: Sim3, now: Sim3, rho: float) -> float:
    """About how far the picture moved, radians; ``rho`` as of :meth:`LensViews.offer`."""
    cosine = 0.5 * (float(np.sum(before.R * now.R)) - 1.0)
    turn = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return turn + rho * float(np.linalg.norm(now.t - before.t))
