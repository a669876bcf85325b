"""Short clips over a procedural floor, tracked, and judged frame by frame.

Lighter than :mod:`aquaflow.lab.synthetic`: grey pictures of a textured height field, a few
milliseconds each, so that a hundred hard clips fit into a minute.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.keyframes import KeyframeStore
from aquaflow.lab.stress.case import Check
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.tracking.frames import Tracked
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

CAMERA = CameraModel(160, 120, 133.0, 133.0, 80.0, 60.0)
"""Small, so that a clip is soon tracked; 62 degrees wide."""
FRAMES = 12
FRAME_NS = 100_000_000
"""Length of a clip, at 10 frames/s."""
TEXTURE_SIZE = 1024
TEXELS_PER_M = 75.0
DEPTH_M = 1.6
"""Of the floor: texels along a side of its texture, texels in a metre, and mean depth."""


class Floor:
    """z = DEPTH_M plus relief, with a texture that repeats every 14 m."""

    def __init__(self, seed: int, relief_m: float = 0.2) -> None:
        self.relief_m = relief_m
        rng = np.random.default_rng(seed)
        texture = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE), np.float32)
        for sigma, weight in ((1.2, 1.0), (3.0, 1.2), (9.0, 1.5)):
            noise = rng.standard_normal(texture.shape).astype(np.float32)
            smooth = cv2.GaussianBlur(noise, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
            texture += weight * smooth / smooth.std()
        self._texture = 120.0 + 32.0 * texture / texture.std()

    def height(
        self,
        x: Array,  # [...] m
        y: Array,  # [...] m, as x
    ) -> Array:
        """Depth of the floor below the origin at x, y, m; the shape of x."""
        relief = np.sin(3.1 * x + 0.5) + 0.8 * np.cos(3.7 * y + 1.3 * x)
        return np.asarray(DEPTH_M + self.relief_m * relief)

    def picture(self, T_wc: Sim3, camera: CameraModel = CAMERA) -> Picture:
        """[H, W, 3] what a camera at ``T_wc`` sees."""
        directions = camera.unproject(camera.pixel_centres()) @ T_wc.R.T
        depth = np.full(directions.shape[:2], DEPTH_M)
        for _ in range(15):
            X = T_wc.t + depth[..., None] * directions
            depth = (self.height(X[..., 0], X[..., 1]) - T_wc.t[2]) / directions[..., 2]
        X = T_wc.t + depth[..., None] * directions
        xy = (X[..., :2] * TEXELS_PER_M % TEXTURE_SIZE).astype(np.float32)
        grey = cv2.remap(self._texture, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR)
        return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def pose(
    translation: tuple[float, float, float], rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Sim3:
    """T_wc from metres and a rotation vector in radians."""
    return Sim3(so3_exp(np.array(rotation)), np.array(translation))


def path(count: int = FRAMES, step_m: float = 0.1) -> list[Sim3]:
    """Poses T_wc of a swim along x with a little of every other motion."""
    poses = []
    for i in range(count):
        s = i / 10.0
        turn = (0.04 * np.sin(2.0 * s), 0.05 * np.sin(1.5 * s + 1.0), 0.06 * np.sin(s))
        poses.append(pose((1.0 + step_m * i, 2.0 + 0.1 * np.sin(s), 0.08 * np.sin(0.9 * s)), turn))
    return poses


def film(
    floor: Floor, poses: Sequence[Sim3], camera: CameraModel = CAMERA, first: int = 0
) -> list[Frame]:
    """One frame per pose, a tenth of a second apart."""
    return [
        Frame(i, i * FRAME_NS, i * FRAME_NS, floor.picture(T_wc, camera), camera)
        for i, T_wc in enumerate(poses, first)
    ]


@lru_cache(maxsize=4)
def clear_swim(seed: int) -> tuple[Frame, ...]:
    """The clip that hard pictures are put into."""
    return tuple(film(Floor(seed), path()))


def spoil(
    frames: Sequence[Frame], which: Sequence[int], change: Callable[[Picture, int], Picture]
) -> list[Frame]:
    """The clip with the pictures of the frames ``which`` replaced by ``change(picture, index)``."""
    from dataclasses import replace

    return [replace(f, image=change(f.image, f.index)) if f.index in which else f for f in frames]


@dataclass(frozen=True)
class Tracking:
    """All results of the tracker for one clip."""

    tracked: list[Tracked]
    keyframes: KeyframeStore

    @property
    def posed(self) -> dict[int, Tracked]:
        """Frames that have a pose, by index."""
        return {t.frame.index: t for t in self.tracked if t.T_wc is not None}


def track(frames: Sequence[Frame]) -> Tracking:
    """Run the tracker, with its default settings, over a clip."""
    store = KeyframeStore()
    tracker = Tracker(ClassicalPrior(), store, TrackingConfig())
    tracked: list[Tracked] = []
    for frame in frames:
        tracked += tracker.track(frame).frames
    return Tracking(tracked + tracker.finish().frames, store)


@lru_cache(maxsize=2)
def clear_tracking(seed: int) -> Tracking:
    """What the tracker says about the clear swim."""
    return track(clear_swim(seed))


def sound(check: Check, frames: Sequence[Frame], result: Tracking) -> None:
    """Invariants of any clip: every frame is accounted for once, every pose is a pose."""
    numbers = sorted(tracked.frame.index for tracked in result.tracked)
    check.true("every frame comes out once", numbers == sorted(f.index for f in frames))
    for tracked in result.tracked:
        if tracked.T_wc is None:
            check.true("a frame without a pose says why", bool(tracked.reason))
        else:
            check.pose(f"pose of frame {tracked.frame.index}", tracked.T_wc)
    for keyframe in result.keyframes.keyframes:
        check.finite("pointmap", keyframe.pointmap.rho, keyframe.pointmap.variance)


def only_these_lost(check: Check, result: Tracking, hurt: Sequence[int], share: float) -> None:
    """None of the ``hurt`` frames has a pose, and at least ``share`` of the others have one."""
    check.true("no pose for a frame that shows nothing", not set(hurt) & set(result.posed))
    others = len(result.tracked) - len(hurt)
    missing = 1.0 - len(set(result.posed) - set(hurt)) / max(others, 1)
    check.below("share of the good frames that were lost", missing, 1.0 - share)


def on_path(
    check: Check, result: Tracking, poses: Sequence[Sim3], bound: float = 0.03, first: int = 0
) -> None:
    """Every posed frame lies on the true path: error over path length, largest sub-map, Sim(3)."""
    maps = [t.sub_map for t in result.posed.values()]
    main = max(set(maps), key=maps.count) if maps else 0
    used = {i: t for i, t in result.posed.items() if t.sub_map == main and t.T_wc is not None}
    if len(used) < 3:
        return
    truth = np.array([poses[i - first].t for i in used])
    found = np.array([t.T_wc.t for t in used.values() if t.T_wc is not None])
    aligned = align(found, truth, with_scale=True).T_target_source.apply(found)
    length = float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    error = np.linalg.norm(aligned - truth, axis=1)
    check.below("largest position error over path length", float(error.max()) / length, bound)
