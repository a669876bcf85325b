"""Poses of pictures with metric depth: each from the one before, by keypoints (paper, Sec. 3.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from aquaflow.lab.training.datasets.posed import Array, Frames, Posed
from aquaflow.prior.contract import Keypoints
from aquaflow.prior.flow import normalised_grey
from aquaflow.prior.homography import clear_matches, detect

RANSAC_PX = 2.0
"""Reprojection error up to which a keypoint agrees with a pose."""
RANSAC_ITERATIONS = 300
"""Samples that are tried."""
MIN_INLIERS = 40
"""Keypoints that agree on the pose; chance makes ten agree (VerificationConfig)."""
MIN_LENGTH = 2
"""Pictures of a stretch that pairs can be found in."""


def chain(frames: Frames) -> list[Frames]:
    """Stretches in which every picture's pose follows from the one before.

    Where two neighbours do not prove their relative pose, one stretch ends and another begins.
    """
    stretches: list[Frames] = []
    readers: list[Callable[[], Posed]] = []
    before: tuple[Posed, Keypoints] | None = None
    T_wc = np.eye(4)
    for number, reader in enumerate(frames.readers):
        posed = reader()
        now = (posed, detect(normalised_grey(posed.image)))
        T_ba = None if before is None else relative_pose(before, now)
        if T_ba is None:
            stretches += _stretch(frames.name, number, readers)
            readers, T_wc = [], np.eye(4)
        else:
            T_wc = T_wc @ np.linalg.inv(T_ba)
        readers.append(partial(_pose, reader, T_wc))
        before = now
    return stretches + _stretch(frames.name, len(frames), readers)


def relative_pose(a: tuple[Posed, Keypoints], b: tuple[Posed, Keypoints]) -> Array | None:
    """[4, 4] T_ba by PnP in RANSAC, refined on its inliers; None without proof."""
    points, pixels = _matches(a, b)
    if len(points) < MIN_INLIERS:
        return None
    K = b[0].K
    found, w, t, inliers = cv2.solvePnPRansac(
        points, pixels, K, None, iterationsCount=RANSAC_ITERATIONS, reprojectionError=RANSAC_PX
    )
    if not found or inliers is None or len(inliers) < MIN_INLIERS:
        return None
    kept = inliers[:, 0]
    w, t = cv2.solvePnPRefineLM(points[kept], pixels[kept], K, None, w, t)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(w)[0], t[:, 0]
    return T if bool(np.isfinite(T).all()) else None


def _matches(a: tuple[Posed, Keypoints], b: tuple[Posed, Keypoints]) -> tuple[Array, Array]:
    """[M, 3] points of a and [M, 2] px in b, where a's depth is known."""
    (view, mine), (_, theirs) = a, b
    none = np.zeros((0, 3)), np.zeros((0, 2))
    if min(len(mine.pixels), len(theirs.pixels)) < MIN_INLIERS:
        return none
    in_a, in_b = clear_matches(mine, theirs)
    if len(in_a) == 0:
        return none
    here, there = mine.pixels[in_a].astype(np.float64), theirs.pixels[in_b].astype(np.float64)
    column, row = np.floor(here).astype(np.int64).T
    z = view.depth[row, column].astype(np.float64)
    rays = np.column_stack([here, np.ones(len(here))]) @ np.linalg.inv(view.K).T
    known = np.isfinite(z) & (z > 0.0)
    return (rays * z[:, None])[known], there[known]


def _pose(
    reader: Callable[[], Posed],
    T_wc: Array,  # [4, 4] m
) -> Posed:
    return replace(reader(), T_wc=T_wc)


def _stretch(name: str, end: int, readers: list[Callable[[], Posed]]) -> list[Frames]:
    if len(readers) < MIN_LENGTH:
        return []
    return [Frames(f"{name}:{end - len(readers)}-{end}", tuple(readers))]
