"""Two small dives over one rendered floor: the first is the base of the second."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from aquaflow.config import Config, parse_config
from aquaflow.dive.deliverables import write_places_of
from aquaflow.geometry.similarity import Sim3
from aquaflow.slam import Slam
from aquaflow.types import Frame
from tests.tracking.tracking_scenes import SeaFloor, filmed, pose

FRAMES = 13
TRACKED_ONLY: Config = parse_config(
    {"threads": 1, "mapping": {"enabled": False}, "source": {"width": 240}}, "test"
)


def first_way() -> list[Sim3]:
    return [
        pose(
            (0.02 * np.sin(i), 0.03 * np.cos(i), 0.0),
            (0.1 * i, 0.2 * np.sin(0.5 * i), 0.05 * np.cos(0.6 * i)),
        )
        for i in range(FRAMES)
    ]


def second_way() -> list[Sim3]:
    """Back over the same floor: turned by 40 degrees, and a fifth higher."""
    return [pose((0.0, 0.02 * np.sin(i), 0.7), (1.2 - 0.1 * i, 0.15, -0.3)) for i in range(FRAMES)]


def in_other_light(frames: list[Frame]) -> list[Frame]:
    """Greener, darker, and with less contrast, as through other water."""
    gain, haze = np.array((0.45, 0.85, 0.7)), np.array((20.0, 45.0, 55.0))
    return [
        replace(frame, image=np.clip(frame.image * gain + haze, 0, 255).astype(np.uint8))
        for frame in frames
    ]


def swum(frames: list[Frame], slam: Slam) -> dict[int, Sim3]:
    """T_nc by frame."""
    for frame in frames:
        slam.process(frame)
    slam.finish()
    return {
        tracked.frame.index: slam.metric_frame(tracked.sub_map).pose(tracked.T_wc)
        for tracked in slam.results()
        if tracked.T_wc is not None
    }


def written_base(folder: Path, floor: SeaFloor) -> dict[int, Sim3]:
    """A dive along the first way, kept in ``folder``; T_mc by frame."""
    slam = Slam(TRACKED_ONLY)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        poses = swum(filmed(floor, first_way()), slam)
        write_places_of(folder, slam, poses)
    finally:
        slam.close()
    return poses
