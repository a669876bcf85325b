"""Does the calibration fit the dive? Focal length and first radial distortion, from matches alone.

Keypoint matches between neighbouring keyframes go through a bundle adjustment that also solves for
the error of the lens. A warning is given only if the error is larger than a good calibration's
own, beyond chance, and the same whether or not the lens may have further terms. A dive of a second
or two has hardly a keyframe; there the frames between are asked, as self-calibration does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.special import fdtrc

from aquaflow.geometry.optics import LENS_PRIOR_SIGMA, TERMS
from aquaflow.keyframes import Keyframe
from aquaflow.tracking.lens_equations import (
    Array,
    LensObservations,
    LensView,
    adjust_lens,
    clusters_of,
    model_error,
    solve_matched,
)
from aquaflow.tracking.self_calibration import MIN_VIEWS as MIN_FRAMES
from aquaflow.tracking.self_calibration import pairs_of as pairs_of_frames

MAX_VIEWS = 8
"""Keyframes used: with the pairs below, ten pairs."""
MIN_VIEWS = 4
"""With fewer, the scatter between the views is no estimate."""
TOLERANCE = np.array([0.02, 0.02])
"""Error of log focal length and k1 that a good calibration in water may have."""
SIGNIFICANCE = 1e-3
"""Probability that a good calibration is reported as wrong."""
KNOWN_SIGMA = np.array([0.03, 0.03])
"""Above, log focal length or k1 is not determined by the dive."""
NAMED_SIGMAS = 3.0
"""An error that is larger by itself is named in the warning."""
LENS_SIGMAS = 3.0
"""Of what lenses are; an error beyond is no lens but an adjustment that went astray, as of a few
pictures of 128 px: k1 = 2.5."""
FRAMES_SIGMA = np.array([0.1, 0.1])
"""Of u and k, of what frames closer together than keyframes share: right calibrations of real clips
come out 4, 9 and 31 % off in 20 frames (notes/2026-11-tracking.md#short-check)."""
GRID = 41
"""Steps along each side of the tolerance."""


@dataclass(frozen=True)
class LensError:
    """Error of a lens calibration, estimated from the matches that used it."""

    log_focal: float
    """u: the focal length should be exp(u) times what it is."""
    radial: float
    """k: the first radial distortion that is left in the undistorted pictures."""
    sigma: Array
    """[2] standard deviations of u and k."""
    chance: float
    """Probability of such an estimate where the calibration is within ``TOLERANCE``."""
    noise_given: float
    """Of the matches, normalised units, with the calibration as it is."""
    noise_fitted: float
    """The same with u and k solved for."""
    noise_further: float
    """The same with r^4 and the centre solved for too: a lens that k1 alone does not describe."""
    views: int
    matches: int

    @property
    def wrong(self) -> bool:
        """True if the calibration does not fit the dive."""
        return self.chance < SIGNIFICANCE

    @property
    def known(self) -> tuple[bool, bool]:
        """Whether the dive's motion determines u, and k."""
        focal, radial = self.sigma < KNOWN_SIGMA
        return bool(focal), bool(radial)

    @property
    def named(self) -> tuple[bool, bool]:
        """Whether u, and k, are wrong by themselves."""
        excess = np.abs([self.log_focal, self.radial]) - TOLERANCE
        focal, radial = excess > NAMED_SIGMAS * self.sigma
        return bool(focal), bool(radial)


def lens_error(keyframes: Sequence[Keyframe]) -> LensError | None:
    """The error of the lens that ``keyframes`` show; None if they are too few or show too little.

    Raises:
        InputError: a keyframe cannot be read back.
    """
    chosen = most_turning([each for each in keyframes if each.T_wc.is_finite()])
    if len(chosen) < MIN_VIEWS:
        return None
    views = [view_of(keyframe) for keyframe in chosen]
    return solve_matched(views, pairs_of(len(views)), estimate)


def lens_error_of_frames(views: Sequence[LensView]) -> LensError | None:
    """The same from frames that follow each other closely, which show gross errors alone."""
    if len(views) < MIN_FRAMES:
        return None
    grossly = partial(estimate, shared_sigma=FRAMES_SIGMA)
    return solve_matched(views, pairs_of_frames(len(views)), grossly)


def view_of(keyframe: Keyframe) -> LensView:
    """What a keyframe shows of the lens.

    Raises:
        InputError: it cannot be read back.
    """
    encoding = keyframe.encoding
    return LensView(encoding.keypoints, encoding.camera, keyframe.T_wc)


def pairs_of(views: int) -> list[tuple[int, int]]:
    """Neighbours, and every other view with the next but one."""
    return [(i, i + 1) for i in range(views - 1)] + [(i, i + 2) for i in range(0, views - 2, 2)]


def estimate(
    observations: LensObservations,
    R_wc: Array,  # [V, 3, 3]
    centres: Array,  # [V, 3] world
    shared_sigma: Array | None = None,  # [2]
) -> LensError:
    """The error of the lens, from poses [V, 3, 3] and [V, 3] that are roughly right.

    ``shared_sigma``: of u and k, beyond what the scatter between the views shows.

    Raises:
        numpy.linalg.LinAlgError: the matches determine nothing at all.
    """
    simple = adjust_lens(observations, R_wc, centres, terms=2)
    full = adjust_lens(observations, R_wc, centres, terms=TERMS)
    covariance = simple.covariance + model_error(simple, full)
    if shared_sigma is not None:
        covariance = covariance + np.diag(shared_sigma**2)
    error = simple.adjusted.lens[:2]
    is_a_lens = (np.abs(error) < LENS_SIGMAS * LENS_PRIOR_SIGMA[:2]).all()
    if not (is_a_lens and np.isfinite(covariance).all()):
        raise np.linalg.LinAlgError("the matches determine no error of the lens")
    return LensError(
        float(error[0]),
        float(error[1]),
        np.sqrt(np.diag(covariance)),
        _chance(error, covariance, len(np.unique(clusters_of(observations)))),
        simple.sigma_held,
        simple.sigma,
        full.sigma,
        len(R_wc),
        len(observations.matches),
    )


def _chance(
    error: Array,  # [2] u and k
    covariance: Array,  # [2, 2] of u and k
    clusters: int,
) -> float:
    """Hotelling's test against the nearest error within the tolerance."""
    side = np.linspace(-1.0, 1.0, GRID)
    within = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) * TOLERANCE
    off = error - within
    squared = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off).min()
    freedom = clusters - 2
    return float(fdtrc(2, freedom, squared * freedom / (2.0 * (clusters - 1))))


def most_turning(keyframes: Sequence[Keyframe], most: int = MAX_VIEWS) -> list[Keyframe]:
    """The run of up to ``most`` keyframes of one sub-map in which the camera turns most.

    A camera that only translates says nothing about its focal length.
    """
    turns = [_angle(a, b) for a, b in pairwise(keyframes)]
    best: list[Keyframe] = []
    best_turn = 0.0
    for start, first in enumerate(keyframes):
        run = [first]
        for keyframe in keyframes[start + 1 : start + most]:
            if keyframe.sub_map != first.sub_map:
                break
            run.append(keyframe)
        turn = sum(turns[start : start + len(run) - 1])
        if (len(run), turn) > (len(best), best_turn):
            best, best_turn = run, turn
    return best


def _angle(a: Keyframe, b: Keyframe) -> float:
    cosine = 0.5 * (float(np.sum(a.T_wc.R * b.T_wc.R)) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
