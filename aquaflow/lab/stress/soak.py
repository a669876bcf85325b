"""Long dives of tiny pictures: memory stays bounded, and no invariant wears off."""

from __future__ import annotations

import resource
from collections.abc import Iterator

import numpy as np

from aquaflow.config import MappingConfig, TrackingConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.lab.stress.case import Check, case
from aquaflow.lab.stress.optimisation import soaked_map
from aquaflow.lab.stress.swim import CAMERA, Floor, film, pose
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame

TINY = CAMERA.resize(64, 48)
"""A camera for thousands of frames."""
SHORT, LONG = 200, 20_000
"""Frames or steps: of a quick case, and of one that would show what slowly grows."""
RADIUS_M, STEP_M = 2.0, 0.05
"""Of the circle, and along it from frame to frame: a round is 251 frames."""
WARM = 50
"""Frames or steps until every buffer has been made once."""
KEYFRAME_KB = 256.0
"""A keyframe of a tiny picture with its pointmap, keypoints and descriptors; all are kept."""
ELSE_MB = 64.0
"""What everything but the keyframes may grow by."""


@case("soak", "geometry.similarity.on_so3")
def tracked_frames(check: Check, seed: int) -> None:
    """200 frames around a circle."""
    _swim_in_circles(check, seed, SHORT)


@case("soak", "geometry.similarity.on_so3", long=True)
def tracked_frames_20000(check: Check, seed: int) -> None:
    """20,000 frames around a circle."""
    _swim_in_circles(check, seed, LONG)


@case("soak", "render.views.refine_pose")
def mapping_steps(check: Check, seed: int) -> None:
    """500 refinement steps of a small map and its poses."""
    _optimise(check, seed, 500)


@case("soak", "render.views.refine_pose", long=True)
def mapping_steps_20000(check: Check, seed: int) -> None:
    """20,000 refinement steps of a small map and its poses."""
    _optimise(check, seed, LONG)


def _circle(seed: int, count: int) -> Iterator[Frame]:
    floor = Floor(seed)
    for i in range(count):
        s = i * STEP_M / RADIUS_M
        T = pose((RADIUS_M * np.cos(s), RADIUS_M * np.sin(s), 0.05 * np.sin(3.0 * s)))
        yield film(floor, [T], TINY, first=i)[0]


def _swim_in_circles(check: Check, seed: int, count: int) -> None:
    store = KeyframeStore()
    tracker = Tracker(ClassicalPrior(), store, TrackingConfig())
    posed, seen, warm_mb, warm_keyframes = 0, 0, 0.0, 0
    for frame in _circle(seed, count):
        for tracked in tracker.track(frame).frames:
            seen += 1
            if tracked.T_wc is not None:
                posed += 1
                check.pose(f"pose of frame {tracked.frame.index}", tracked.T_wc)
        if frame.index == WARM:
            warm_mb, warm_keyframes = _peak_mb(), len(store)
    seen += len(tracker.finish().frames)
    check.true("every frame comes out once", seen == count)
    check.below("share of frames without a pose", 1.0 - posed / count, 0.2)
    allowed_mb = ELSE_MB + (len(store) - warm_keyframes) * KEYFRAME_KB / 1024.0
    check.below("growth of memory in MB", _peak_mb() - warm_mb, allowed_mb)


def _optimise(check: Check, seed: int, steps: int) -> None:
    settings = MappingConfig.model_validate({
        "medium": {"enabled": False}, "optimiser": {"refine_steps": steps, "prune_every": 10**6},
    })  # fmt: skip
    mapper = soaked_map(seed, settings)
    mapper.optimise(WARM)
    before_mb = _peak_mb()
    mapper.refine()
    check.true("every step is taken", mapper.steps + mapper.undone == steps + WARM)
    check.true("none is undone", mapper.undone == 0)
    check.finite("map", *mapper.gaussians.parameters.values())
    check.true("scales are positive", bool((mapper.gaussians.scales > 0.0).all()))
    length = mapper.gaussians.parameters["quats"].norm(dim=1)
    check.true("quaternions keep a direction", bool((length > 1e-6).all()))
    opacities = mapper.gaussians.opacities
    check.true("opacities are shares", bool(((opacities >= 0.0) & (opacities <= 1.0)).all()))
    for view in mapper.views:
        check.pose(f"pose of view {view.frame_index}", view.T_wc)
        check.true("its scale is kept", view.T_wc.scale == Sim3.identity().scale)
    check.below("growth of memory in MB", _peak_mb() - before_mb, ELSE_MB)


def _peak_mb() -> float:
    """Largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
