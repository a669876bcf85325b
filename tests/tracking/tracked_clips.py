"""A clip through the tracker, and how far what came out is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aquaflow.base.worker import Worker
from aquaflow.config import InitialisationConfig, TrackingConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.contract import Prior
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame
from tests.tracking.tracking_scenes import KnownPrior, KnownView, pose

PLACED = {FrameClass.KEYFRAME, FrameClass.MAPPING, FrameClass.COMMON}


class Prompt(Worker):
    """Of a vehicle, but with every answer at once."""

    @property
    def in_step(self) -> bool:
        return False


@dataclass
class Run:
    """All that came out of one clip."""

    tracked: list[Tracked]
    store: KeyframeStore
    tracker: Tracker

    def by_index(self) -> dict[int, Tracked]:
        return {tracked.frame.index: tracked for tracked in self.tracked}


def run(
    frames: Sequence[Frame], config: TrackingConfig | None = None, prior: Prior | None = None
) -> Run:
    store = KeyframeStore()
    tracker = Tracker(prior or ClassicalPrior(), store, config or TrackingConfig())
    tracked: list[Tracked] = []
    for frame in frames:
        tracked += tracker.track(frame).frames
    tracked += tracker.finish().frames
    # Whatever happens in between: every frame comes out exactly once.
    assert sorted(t.frame.index for t in tracked) == sorted(f.index for f in frames)
    return Run(tracked, store, tracker)


def error_share(tracked: Sequence[Tracked], poses: Sequence[Sim3]) -> float:
    """RMSE of the positions after a Sim(3) alignment, over the length of the path."""
    placed = [(t.frame.index, t.T_wc.t) for t in tracked if t.T_wc is not None]
    found = np.array([t for _, t in sorted(placed, key=lambda item: item[0])])
    truth = np.array([poses[index].t for index in sorted(index for index, _ in placed)])
    moved = align(found, truth, with_scale=True).T_target_source.apply(found)
    length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(np.sqrt(((moved - truth) ** 2).sum(1).mean()) / length)


# --- matches that are told the truth -------------------------------------------------------------

SMALL = CameraModel(96, 72, 80.0, 80.0, 48.0, 36.0)
QUICK = TrackingConfig(
    initialisation=InitialisationConfig(points=300, pairs=1, parallax_widths=0.01)
)
"""A plane in a narrow picture shows little parallax once a rotation is fitted to it."""


def told(poses: Sequence[Sim3], blind: Sequence[int] = (), noise_px: float = 0.05) -> KnownPrior:
    """A prior that knows the poses; all views look at one plane, so every depth is exact."""
    views = [KnownView(SMALL, T, plane_depth(T), blind=i in blind) for i, T in enumerate(poses)]
    return KnownPrior(views, SMALL, noise_px)


def plane_depth(T_wc: Sim3) -> np.ndarray:
    """[H, W] of the tilted plane of ``depth_map``, seen from ``T_wc``."""
    normal = np.array([0.1, -0.25, 0.96])
    directions = SMALL.unproject(SMALL.pixel_centres()) @ T_wc.R.T
    return np.asarray((1.5 - T_wc.t @ normal) / (directions @ normal))


def path(count: int, step: float = 0.05) -> list[Sim3]:
    """Curved: over a plane, a straight way has two explanations that are equally good."""
    return [
        pose(
            (0.01 * i, 0.02 * i, -0.03 * i),
            (step * i, 1.5 * step * np.sin(0.9 * i), 0.5 * step * np.sin(1.7 * i)),
        )
        for i in range(count)
    ]
