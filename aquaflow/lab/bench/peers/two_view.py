"""The low end: two-frame visual odometry as in any tutorial.

Corners are followed by Lucas-Kanade from picture to picture; the essential matrix gives rotation
and direction; the length of each step comes from the ratio of depths of corners that the step
before triangulated too. Nothing is optimised and nothing remembered.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.bench.peers.dive import PeerResult
from aquaflow.types import Frame

Array = npt.NDArray[np.float64]

CORNERS, QUALITY, APART_PX = 800, 0.005, 5
"""Of goodFeaturesToTrack: most corners, share of the best one's strength, and distance."""
WINDOW_PX, LEVELS = 15, 4
"""Of the pyramid of Lucas and Kanade: window, and levels above the picture itself."""
ROUND_TRIP_PX = 0.7
"""A corner that does not come back to where it started was lost."""
STILL_PX = 0.4
"""Median motion below which the camera stands still: no geometry comes from noise."""
FEWEST = 12
"""Matches: five determine the essential matrix, and about as many again must confirm it."""
RANSAC_PX, RANSAC_CONFIDENCE = 0.7, 0.999
"""Distance to the epipolar line (px), and the probability that a sample without outlier is
drawn."""
NEAR_PX = 5
"""Corners are found anew in every picture; within this window they are the same corner."""
SHORTEST, LONGEST = 0.2, 5.0
"""Bounds on a step over the one before; few shared corners must not blow up the path."""


@dataclass
class _State:
    grey: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    """[H, W] of the corners that the last step triangulated, in map units; 0 elsewhere."""
    T_wc: Sim3
    step: float = 1.0
    """Length of the last step, map units."""


@dataclass(frozen=True)
class _Step:
    R: Array
    """[3, 3] from the old camera to the new."""
    t: Array
    """[3] of length 1."""
    old_px: Array
    new_px: Array
    """[M, 2]"""
    old_depth: Array
    new_depth: Array
    """[M] in lengths of the step."""


def solve(frames: list[Frame]) -> PeerResult:
    """Chain relative poses; a step that cannot be solved repeats no motion at all."""
    started = time.perf_counter()
    poses, frame_ms = {0: Sim3.identity()}, []
    state, first_pose_s = _begin(frames[0]), 0.0
    for i, frame in enumerate(frames[1:], 1):
        begun = time.perf_counter()
        state = _advance(state, frame)
        poses[i] = state.T_wc
        frame_ms.append(1e3 * (time.perf_counter() - begun))
        first_pose_s = first_pose_s or time.perf_counter() - started
    return PeerResult(poses, time.perf_counter() - started, first_pose_s, frame_ms)


def _begin(frame: Frame) -> _State:
    grey = _grey(frame)
    return _State(grey, np.zeros(grey.shape, np.float32), Sim3.identity())


def _grey(frame: Frame) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _advance(state: _State, frame: Frame) -> _State:
    grey = _grey(frame)
    old, new = _follow(state.grey, grey)
    still = len(old) > 0 and np.median(np.linalg.norm(new - old, axis=1)) < STILL_PX
    moved = None if still or len(old) < FEWEST else _motion(old, new, frame.camera.K)
    if moved is None:
        return _State(grey, np.zeros(grey.shape, np.float32), state.T_wc, state.step)
    length = _length(state, moved)
    depth = np.zeros(grey.shape, np.float32)
    x, y = _cells(moved.new_px, grey.shape)
    depth[y, x] = length * moved.new_depth
    depth = cv2.dilate(depth, np.ones((NEAR_PX, NEAR_PX), np.uint8)).astype(np.float32)
    # X_new = R X_old + t, so the new camera in the old one's axes is the inverse.
    T_old_new = Sim3(moved.R.T, -moved.R.T @ (length * moved.t), 1.0)
    return _State(grey, depth, state.T_wc @ T_old_new, length)


def _follow(
    old: npt.NDArray[np.uint8],  # [H, W] grey
    new: npt.NDArray[np.uint8],  # [H, W] grey
) -> tuple[Array, Array]:
    """Corners [M, 2] in the old picture and where they went (OpenCV's pixels)."""
    corners = cv2.goodFeaturesToTrack(old, CORNERS, QUALITY, APART_PX)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    size, guess = (WINDOW_PX, WINDOW_PX), np.empty_like(corners)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        old, new, corners, guess, winSize=size, maxLevel=LEVELS
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        new, old, there, guess.copy(), winSize=size, maxLevel=LEVELS
    )
    start, end, again = (np.asarray(p, np.float64).reshape(-1, 2) for p in (corners, there, back))
    kept = (found.ravel() > 0) & (returned.ravel() > 0)
    kept &= np.linalg.norm(again - start, axis=1) < ROUND_TRIP_PX
    return start[kept], end[kept]


def _motion(
    old: Array,  # [M, 2] OpenCV's pixels
    new: Array,  # [M, 2] OpenCV's pixels
    K: Array,  # [3, 3] px
) -> _Step | None:
    """Rotation, direction and depths from two sets of pixels [M, 2]; None where they disagree."""
    shifted = K.copy()
    shifted[:2, 2] -= 0.5  # our pixel centres are at 0.5, OpenCV's at 0
    E, inliers = cv2.findEssentialMat(
        old, new, shifted, method=cv2.RANSAC, prob=RANSAC_CONFIDENCE, threshold=RANSAC_PX
    )
    if E is None or E.shape != (3, 3):
        return None
    count, R_found, t_found, good = cv2.recoverPose(E, old, new, shifted, mask=inliers)
    if count < FEWEST:
        return None
    R, t = np.asarray(R_found, np.float64), np.asarray(t_found, np.float64).reshape(3)
    chosen = np.asarray(good).ravel() > 0
    a, b = old[chosen], new[chosen]
    projected = shifted @ np.hstack([R, t[:, None]])
    X = np.asarray(cv2.triangulatePoints(shifted @ np.eye(3, 4), projected, a.T, b.T))
    old_points = (X[:3] / np.where(np.abs(X[3]) > 1e-12, X[3], 1e-12)).T
    old_depth, new_depth = old_points[:, 2], (old_points @ R.T + t)[:, 2]
    ahead = (old_depth > 0.0) & (new_depth > 0.0)
    return _Step(R, t, a[ahead], b[ahead], old_depth[ahead], new_depth[ahead])


def _length(state: _State, moved: _Step) -> float:
    """The step in map units: depths that the step before knew, over this one's."""
    x, y = _cells(moved.old_px, state.depth.shape)
    known = state.depth[y, x]
    shared = known > 0.0
    if shared.sum() < FEWEST:
        return state.step
    ratio = float(np.median(known[shared] / moved.old_depth[shared]))
    return float(np.clip(ratio, SHORTEST * state.step, LONGEST * state.step))


def _cells(
    pixels: Array,  # [M, 2] OpenCV's pixels
    shape: tuple[int, ...],
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Column and row of each pixel [M, 2], inside the picture."""
    at = np.round(pixels).astype(np.intp)
    return np.clip(at[:, 0], 0, shape[1] - 1), np.clip(at[:, 1], 0, shape[0] - 1)
