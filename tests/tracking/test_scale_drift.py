"""Scale over a swim across a known floor: no keyframe inherits a bias from the one before."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from aquaflow.config import TrackingConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.tracking.tracker import Tracker
from tests.tracking.tracking_scenes import Array, SeaFloor, filmed, pose

STEP_M = 0.12


def swim(count: int) -> list[Sim3]:
    """Poses T_wc along x, 12 cm apart, with a slow sway of every other motion."""
    i = np.arange(count)
    turns = np.stack(
        [0.04 * np.sin(0.2 * i), 0.05 * np.sin(0.15 * i + 1.0), 0.06 * np.sin(0.1 * i)]
    )
    centres = np.stack([STEP_M * i - 0.5, 0.12 * np.sin(0.12 * i), 0.1 * np.sin(0.09 * i)])
    return [pose(tuple(w), tuple(t)) for w, t in zip(turns.T, centres.T, strict=True)]


def log_scales(poses: list[Sim3]) -> Array:
    """Logarithm of estimated over true distance between successive keyframes."""
    store = KeyframeStore()
    tracker = Tracker(ClassicalPrior(), store, TrackingConfig())
    for frame in filmed(SeaFloor(), poses):
        tracker.track(frame)
    keyframes = store.keyframes
    ratios = []
    for before, after in pairwise(keyframes):
        true = poses[after.frame_index].t - poses[before.frame_index].t
        estimated = after.T_wc.t - before.T_wc.t
        ratios.append(np.linalg.norm(estimated) / np.linalg.norm(true))
    return np.log(np.array(ratios))


def test_scale_holds_from_keyframe_to_keyframe() -> None:
    """Plain DIS matches, depths of the nearest pixel: spread 0.8 %, -9 % per 100 keyframes."""
    scales = log_scales(swim(48))
    assert len(scales) > 12
    assert scales.std() < 0.004
    slope = np.polyfit(np.arange(len(scales)), scales, 1)[0]
    assert abs(100.0 * slope) < 0.03
