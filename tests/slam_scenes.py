"""Slam behind a tracker whose decisions the test states."""

from __future__ import annotations

import numpy as np

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.config import Config, parse_config
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.slam import Slam
from aquaflow.tracking.frames import FrameClass, Step, Tracked
from aquaflow.types import Frame

CAMERA = CameraModel(64, 48, 55.0, 55.0, 32.0, 24.0)
STEPS = {"steps_keyframe": 3, "steps_mapping": 2, "steps_common": 1, "refine_steps": 4}
OPEN_GATE = dict.fromkeys(("skip_duplicates", "skip_dark", "skip_blurred", "skip_blinded"), False)


def config(gate: dict[str, bool] | None = None, **mapping: object) -> Config:
    tracking = {"gate": gate or {}}
    settings = {"threads": 1, "tracking": tracking, "mapping": {"optimiser": STEPS, **mapping}}
    return parse_config(settings, "test")


def frame_of(index: int) -> Frame:
    rng = np.random.default_rng(index)
    image = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    return Frame(index, index, index, image, CAMERA)


def pointmap(height: int = 48, width: int = 64) -> Pointmap:
    rho = np.full((height, width), 0.5)
    return Pointmap(CAMERA.resize(width, height), rho, (0.01 * rho) ** 2)


class ToldTracker:
    """Decides every frame at once as it is told; keyframes go to the store as they do in truth."""

    camera: CameraModel | None = None
    lost, sub_map = False, 0

    def __init__(self, slam: Slam, classes: str, sub_maps: str = "") -> None:
        self._slam, self._classes, self._sub_maps = slam, classes, sub_maps or "0" * len(classes)

    def track(self, frame: Frame) -> Step:
        return Step([self._decided(frame)])

    def _decided(self, frame: Frame) -> Tracked:
        kind, sub_map = self._classes[frame.index], int(self._sub_maps[frame.index])
        if kind == "L":
            return Tracked(frame, FrameClass.LOST, sub_map, reason="told so")
        T_wc = Sim3(np.eye(3), np.array([0.01 * frame.index, 0.0, 0.0]))
        frame_class, seen = FrameClass.COMMON, None
        if kind in "KM":
            frame_class = FrameClass.KEYFRAME if kind == "K" else FrameClass.MAPPING
            seen = pointmap(*frame.image.shape[:2])
        if kind == "K":
            encoding = self._slam.prior.encode(frame.image, CAMERA)
            depths = pointmap(*frame.image.shape[:2])
            self._slam.keyframes.add(frame.index, 0, encoding, T_wc, depths, sub_map)
        number = len(self._slam.keyframes) - 1
        return Tracked(frame, frame_class, sub_map, number, T_wc, pointmap=seen)

    def finish(self, until: Deadline | None = None) -> Step:
        return Step()
