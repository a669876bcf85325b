"""Scenes with a known answer: rendered pictures of a hilly floor, exact matches of any scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.prior.contract import Keypoints, RangeUnit
from aquaflow.tracking.pose.solver import PoseProblem
from aquaflow.types import Frame

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

CAMERA = CameraModel(240, 180, 200.0, 200.0, 120.0, 90.0)
TEXELS_PER_M = 110.0
TEXTURE_SIZE = 1400
FRAME_NS = 100_000_000


def pose(rotation: tuple[float, float, float], translation: tuple[float, float, float]) -> Sim3:
    return Sim3(so3_exp(np.array(rotation)), np.array(translation))


# --- exact points ---------------------------------------------------------------------------------


def cloud(seed: int, count: int = 300, flat: bool = False) -> Array:
    """[M, 3] points in the keyframe's camera frame, spread over the picture."""
    rng = np.random.default_rng(seed)
    pixels = np.stack([rng.uniform(5, 235, count), rng.uniform(5, 175, count)], -1)
    rays = CAMERA.unproject(pixels)
    depth = 1.5 / (rays @ np.array([0.1, -0.2, 0.97])) if flat else rng.uniform(0.8, 2.5, count)
    return rays * depth[:, None]


def problem_of(
    points: Array, T: Sim3, seed: int = 0, noise_px: float = 0.0, sigma_px: float = 0.5
) -> PoseProblem:
    """The points seen from ``T``; their depths are stated to be exact."""
    pixels = CAMERA.project(T.apply(points))
    pixels = pixels + np.random.default_rng(seed).normal(0, 1, pixels.shape) * noise_px
    nothing, one = np.zeros(len(points)), np.ones(len(points))
    return PoseProblem(points, nothing, pixels, one, CAMERA, sigma_px)


# --- exact matches behind the prior contract ------------------------------------------------------


@dataclass
class KnownView:
    """An encoding that knows where its camera was and what is in front of it."""

    camera: CameraModel
    T_wc: Sim3
    depth: Array
    """[H, W]"""
    blind: bool = False

    @property
    def interesting(self) -> Mask:
        return np.ones(self.depth.shape, bool)

    @property
    def keypoints(self) -> Keypoints:
        return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))


class KnownPair:
    """Matches of two known views, with noise; only a's side is exact, b's is by nearest pixel."""

    D_a = D_b = None
    range_unit: RangeUnit = "shared"

    def __init__(self, a: KnownView, b: KnownView, noise_px: float, true: CameraModel) -> None:
        T_ba = b.T_wc.inverse() @ a.T_wc
        rng = np.random.default_rng(0)
        self.matches, self.valid = _seen(a, T_ba, true)
        self.matches = self.matches + (noise_px * rng.normal(size=self.matches.shape)).astype(
            np.float32
        )
        self.matches_back, self.valid_back = _seen(b, T_ba.inverse(), true)
        if a.blind or b.blind:
            self.valid, self.valid_back = np.zeros_like(self.valid), np.zeros_like(self.valid)
        self.C = self.valid.astype(np.float32)
        self.X_a = self.X_b = self.Q_a = self.Q_b = None


def _seen(view: KnownView, T: Sim3, camera: CameraModel) -> tuple[npt.NDArray[np.float32], Mask]:
    """Where the other camera, at ``T``, sees every pixel of ``view``, and which it sees."""
    Y = T.apply(camera.unproject(camera.pixel_centres()) * view.depth[..., None])
    pixels = camera.project(Y)
    inside = ((pixels > 2.0) & (pixels < (camera.width - 2.0, camera.height - 2.0))).all(-1)
    return np.clip(pixels, -1e4, 1e4).astype(np.float32), inside & (Y[..., 2] > 1e-3)


class KnownPrior:
    """A prior that is told the truth through the frames' indices."""

    name, matching, ranged, metric, unit_sigma = "known", "true", False, False, np.inf

    def __init__(self, views: list[KnownView], true: CameraModel, noise_px: float = 0.1) -> None:
        self.views, self.true, self.noise_px = views, true, noise_px
        self.predictions: list[npt.NDArray[np.float32] | None] = []

    def encode(
        self,
        image: npt.NDArray[np.uint8],
        camera: CameraModel,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> KnownView:
        return replace(self.views[int(image[0, 0, 0])], camera=camera)

    def decode(
        self,
        a: KnownView,
        b: KnownView,
        predicted: npt.NDArray[np.float32] | None = None,
        alone: bool = False,
    ) -> KnownPair:
        self.predictions.append(predicted)
        return KnownPair(a, b, self.noise_px, self.true)

    def frames(self, camera: CameraModel) -> list[Frame]:
        """One frame per view; its first pixel says which."""
        pictures = [np.full((2, 2, 3), i, np.uint8) for i in range(len(self.views))]
        return [Frame(i, i * FRAME_NS, 0, picture, camera) for i, picture in enumerate(pictures)]


def depth_map(camera: CameraModel, flat: bool) -> Array:
    """[H, W] of a tilted plane, or of hills."""
    rays = camera.unproject(camera.pixel_centres())
    if flat:
        return np.asarray(1.5 / (rays @ np.array([0.1, -0.25, 0.96])))
    x, y = rays[..., 0], rays[..., 1]
    return np.asarray(1.5 + 0.45 * np.sin(7.0 * x + 1.0) + 0.3 * np.cos(8.0 * y + 3.0 * x))


# --- rendered pictures ----------------------------------------------------------------------------


@cache
def texture(seed: int) -> npt.NDArray[np.float32]:
    """[TEXTURE_SIZE, TEXTURE_SIZE] grey values 0 to 255; made once, and only where one is seen."""
    rng = np.random.default_rng(seed)
    total = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE))
    for sigma in (1.2, 3.0, 9.0):
        layer = cv2.GaussianBlur(rng.normal(size=total.shape), (0, 0), sigma)
        total += layer / layer.std()
    return np.clip(127.0 + 32.0 * total, 0, 255).astype(np.float32)


class SeaFloor:
    """A textured heightfield below z = 0; cameras look down at it along +z."""

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed

    @staticmethod
    def height(x: Array, y: Array) -> Array:
        return np.asarray(1.6 + 0.22 * np.sin(3.1 * x + 0.5) + 0.18 * np.cos(3.7 * y + 1.3 * x))

    def depth(self, T_wc: Sim3, camera: CameraModel = CAMERA) -> Array:
        """[H, W] z of every pixel, by fixed-point iteration along its ray."""
        directions = camera.unproject(camera.pixel_centres()) @ T_wc.R.T
        depth = np.full(directions.shape[:2], 1.5)
        for _ in range(25):
            X = T_wc.t + depth[..., None] * directions
            depth = (self.height(X[..., 0], X[..., 1]) - T_wc.t[2]) / directions[..., 2]
        return depth

    def picture(self, T_wc: Sim3, camera: CameraModel = CAMERA) -> npt.NDArray[np.uint8]:
        directions = camera.unproject(camera.pixel_centres()) @ T_wc.R.T
        X = T_wc.t + self.depth(T_wc, camera)[..., None] * directions
        xy = (X[..., :2] * TEXELS_PER_M + TEXTURE_SIZE / 2).astype(np.float32)
        grey = cv2.remap(
            texture(self.seed), xy[..., 0], xy[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP
        )
        return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def lawn_path(count: int, step_m: float = 0.08) -> list[Sim3]:
    """Poses T_wc of a swim along x with a little of every other motion."""
    poses = []
    for i in range(count):
        s = i / 10.0
        turn = (0.04 * np.sin(2.0 * s), 0.05 * np.sin(1.5 * s + 1.0), 0.06 * np.sin(s))
        poses.append(pose(turn, (step_m * i - 0.5, 0.12 * np.sin(1.2 * s), 0.10 * np.sin(0.9 * s))))
    return poses


def filmed(floor: SeaFloor, poses: list[Sim3]) -> list[Frame]:
    return [
        Frame(i, i * FRAME_NS, i * FRAME_NS, floor.picture(T_wc), CAMERA)
        for i, T_wc in enumerate(poses)
    ]


def black(index: int) -> Frame:
    picture = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    return Frame(index, index * FRAME_NS, index * FRAME_NS, picture, CAMERA)
