"""Long dives at one place: tracking does not drift, and neither keyframes nor memory grow."""

from __future__ import annotations

import resource
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from aquaflow.config import Config
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.stress.case import Check, case
from aquaflow.lab.stress.one_place import OnePlace
from aquaflow.lab.stress.swim import CAMERA
from aquaflow.slam import Slam

MINUTE, TWO_HOURS = 300, 72_000
"""Frames: of half a minute over two places, and of a dive whose drift would show."""
SMALL = CAMERA.resize(128, 96)
ERROR_M = 0.1
"""RMS distance from the truth, 1.6 m above the floor; a diverged dive is metres away."""
HALF_GROWTH = 0.05
"""Of keyframes and memory over the second half."""
TRACKING_ONLY = Config.model_validate({"mapping": {"enabled": False}})


@case("soak", "tracking.consistency.ConsistencyMonitor.after")
def half_a_minute_at_one_place(check: Check, seed: int) -> None:
    """The vehicle leaves and comes back twice; the monitor finds nothing."""
    _hover(check, OnePlace(seed, SMALL), MINUTE)


@case("soak", "tracking.keyframe_reuse.KeyframeReuse.due", long=True)
def two_hours_at_one_place(check: Check, seed: int) -> None:
    """72,000 frames, 360 times away and back; half an hour of a core."""
    half, end = _hover(check, OnePlace(seed), TWO_HOURS)
    check.below("growth of keyframes", end[0] / half[0] - 1.0, HALF_GROWTH)
    check.below("growth of edges of the graph", end[1] / half[1] - 1.0, HALF_GROWTH)
    check.below("growth of peak memory", end[2] / half[2] - 1.0, HALF_GROWTH)


def _hover(check: Check, place: OnePlace, count: int) -> list[tuple[float, float, float]]:
    """Keyframes, edges and peak memory at half the dive and at its end."""
    seen, sizes = 0, []
    with TemporaryDirectory() as folder:
        slam = Slam(TRACKING_ONLY, work=Path(folder))
        try:
            for index in range(count):
                seen += len(slam.process(place.frame(index)))
                if index + 1 in (count // 2, count):
                    sizes.append(_sizes(slam))
            seen += len(slam.finish_tracking())
            _judge(check, slam, place, count)
        finally:
            slam.close()
    check.true("every frame comes out once", seen == count)
    return sizes


def _sizes(slam: Slam) -> tuple[float, float, float]:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(len(slam.keyframes)), float(len(slam.graph.snapshot.edges)), float(peak)


def _judge(check: Check, slam: Slam, place: OnePlace, count: int) -> None:
    poses: dict[int, Sim3] = {}
    for tracked in slam.results():
        if tracked.T_wc is not None:
            check.pose(f"pose of frame {tracked.frame.index}", tracked.T_wc)
            poses[tracked.frame.index] = tracked.T_wc
    check.below("share of frames without a pose", 1.0 - len(poses) / count, 0.02)
    check.true("the monitor finds nothing", slam.tracker.monitor.counts.found == 0)
    found = np.array([T_wc.t for T_wc in poses.values()])
    truth = np.array([place.T_wc(index).t for index in poses])
    moved = align(found, truth, with_scale=True).T_target_source.apply(found)
    error = float(np.sqrt(((moved - truth) ** 2).sum(1).mean()))
    check.below("RMS position error in m", error, ERROR_M)
