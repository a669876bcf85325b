"""Starts of a camera that moves along its view: the epipole in the picture, tiles that repeat."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.config import Config, InitialisationConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.geometry.similarity import Sim3, so3_exp, so3_log
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.slam import Slam
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.tracking.initialisation.initialiser import Initialised, Initialiser
from aquaflow.types import Frame
from tests.tracking.tracking_scenes import FRAME_NS, KnownPair, KnownPrior, KnownView, depth_map

CAMERA = CameraModel(320, 180, 340.0, 340.0, 160.0, 90.0)
CONFIG = InitialisationConfig()
HEIGHT_M, PITCH_RAD, TILE_M, STEP_M = 0.2, 0.45, 0.025, 0.03
"""Of a crawler in a mosaic pool at one picture a second: more than a tile from one to the next."""
TEXEL_M = 0.001
SUPERSAMPLED = 4
"""Rays a side of a pixel, or far tiles alias in the scene, not in the camera."""


def crawled(count: int) -> list[Sim3]:
    """T_wc; straight ahead along z of a level world whose y points down, with a nod of its own."""
    nod = 0.004 * np.sin(1.9 * np.arange(count))
    return [
        Sim3(so3_exp(np.array([-PITCH_RAD + nod[i], 0.0, 0.0])), np.array([0.0, 0.0, STEP_M * i]))
        for i in range(count)
    ]


def mosaic(tint: float) -> np.ndarray:
    """[H, W] grey floor: light joints, tiles that differ by ``tint`` grey levels, stains on a few,
    and a rope along the way."""
    rng = np.random.default_rng(3)
    size, tile = 2400, round(TILE_M / TEXEL_M)
    floor = np.full((size, size), 70.0)
    tints = rng.normal(0.0, tint, (size // tile + 1, size // tile + 1))
    floor += np.kron(tints, np.ones((tile, tile)))[:size, :size]
    joint = np.arange(size) % tile < round(0.16 * tile)
    floor[joint] = floor[:, joint] = 190.0
    stains = cv2.GaussianBlur(rng.normal(0.0, 1.0, (size, size)), (0, 0), 9.0)
    floor[stains > 2.0 * stains.std()] = 150.0
    middle = slice(size // 2 - 20, size // 2 + 20)
    rope = cv2.GaussianBlur(rng.normal(0.0, 1.0, (size, 40)), (0, 0), 4.0)
    floor[:, middle] = 100.0 + 60.0 * rope / rope.std()
    return np.clip(floor, 0, 255).astype(np.float32)


def filmed(poses: list[Sim3], tint: float = 12.0, noise: float = 2.0) -> list[Frame]:
    """Pictures of the mosaic, at a camera's noise and after a JPEG of a recorder."""
    floor, rng, frames = mosaic(tint), np.random.default_rng(0), []
    n = SUPERSAMPLED
    fine = CameraModel(
        n * CAMERA.width, n * CAMERA.height, n * CAMERA.fx, n * CAMERA.fy, n * CAMERA.cx,
        n * CAMERA.cy,
    )  # fmt: skip
    rays = fine.unproject(fine.pixel_centres())
    for i, T_wc in enumerate(poses):
        there = rays @ T_wc.R.T
        far = there[..., 1] < 0.05
        points = T_wc.t + there * (HEIGHT_M / np.where(far, 1.0, there[..., 1]))[..., None]
        texels = (points[..., ::2] / TEXEL_M + (1200.0, 100.0)).astype(np.float32)
        picture = cv2.remap(floor, texels, None, cv2.INTER_LINEAR, borderValue=110.0)
        picture[far] = 110.0
        picture = cv2.resize(picture, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
        grey = np.clip(picture + rng.normal(0.0, noise, picture.shape), 0, 255).astype(np.uint8)
        packed = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
        image = cv2.cvtColor(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), cv2.COLOR_GRAY2RGB)
        frames.append(Frame(i, i * FRAME_NS, 0, np.asarray(image, np.uint8), CAMERA))
    return frames


def first_start(frames: list[Frame]) -> Initialised | None:
    """Of the first reference, as the frames come."""
    prior = ClassicalPrior()
    initialiser = Initialiser(frames[0], prior.encode(frames[0].image, CAMERA), prior, CONFIG)
    for frame in frames[1:]:
        if not initialiser.add(frame, prior.encode(frame.image, CAMERA)):
            return None
        started = initialiser.solve() if initialiser.ready else None
        if started is not None:
            return started
    return None


@pytest.mark.parametrize("tint", [6.0, 12.0])
def test_forward_motion_over_tiles_starts_before_they_are_mistaken_for_each_other(
    tint: float,
) -> None:
    poses = crawled(6)
    started = first_start(filmed(poses, tint))
    assert started is not None
    assert len(started.waiting) <= 4
    for waiting, T_fk in zip(started.waiting, started.T, strict=True):
        truth = poses[waiting.frame.index].inverse() @ poses[0]
        turn = np.degrees(np.linalg.norm(so3_log(T_fk.R @ truth.R.T)))
        ways = [-T.R.T @ T.t / np.linalg.norm(T.t) for T in (T_fk, truth)]
        assert turn < 0.5
        assert np.degrees(np.arccos(np.clip(ways[0] @ ways[1], -1.0, 1.0))) < 4.0


def test_nothing_starts_in_front_of_tiles_while_only_the_camera_turns() -> None:
    poses = [Sim3(T.R @ so3_exp(np.array([0.0, 0.03 * i, 0.0])), 0.0 * T.t)
             for i, T in enumerate(crawled(6))]  # fmt: skip
    assert first_start(filmed(poses)) is None


class FadingPrior(KnownPrior):
    """Right matches, of which each later picture is sure of half as many."""

    def decode(
        self,
        a: KnownView,
        b: KnownView,
        predicted: np.ndarray | None = None,
        alone: bool = False,
    ) -> KnownPair:
        pair = super().decode(a, b, predicted, alone)
        kept = np.random.default_rng(1).random(pair.valid.shape) < 0.5 ** len(self.predictions)
        pair.C = (pair.valid & kept).astype(np.float32)
        return pair


def test_over_a_plane_little_parallax_starts_nothing_that_has_a_rival() -> None:
    """Seen from two places on a straight way, a plane has two explanations, both exact."""
    poses = [Sim3(so3_exp(np.zeros(3)), np.array([0.03 * i, 0.0, 0.01 * i])) for i in range(6)]
    views = [KnownView(CAMERA, T, depth_map(CAMERA, flat=True)) for T in poses]
    prior = FadingPrior(views, CAMERA, 0.05)
    frames = prior.frames(CAMERA)
    initialiser = Initialiser(frames[0], prior.encode(frames[0].image, CAMERA), prior, CONFIG)
    tried = 0
    for frame in frames[1:]:
        assert initialiser.add(frame, prior.encode(frame.image, CAMERA))
        if initialiser.parallax_px >= CONFIG.parallax_widths * CAMERA.width:
            break
        if initialiser.ready:
            tried += 1
            started = initialiser.solve()
            if started is not None:
                ways = [-T.R.T @ T.t / np.linalg.norm(T.t) for T in started.T]
                truth = poses[1].t / np.linalg.norm(poses[1].t)
                assert all(way @ truth > np.cos(np.radians(5.0)) for way in ways)
    assert tried


@pytest.mark.ci
def test_every_picture_of_a_real_tiled_pool_has_a_pose(shared_data: Path) -> None:
    """A crawler that moves straight ahead, one picture a second; before it lost its first 37."""
    folder, count = shared_data / "pool_forward", 24
    if not folder.is_dir():
        pytest.skip(f"the pictures of the tiled pool are not at {folder}")
    config = Config.model_validate({"source": {"width": 480}, "mapping": {"enabled": False}})
    prepared = Preparation(config.source, load_camera(folder / "camera.yaml"))
    slam = Slam(config)
    try:
        for frame in open_recording(folder, 1.0).frames(1, 0, count):
            assert isinstance(frame, Frame)
            slam.process(prepared(frame))
        slam.finish()
        results = sorted(slam.results(), key=lambda each: each.frame.index)
    finally:
        slam.close()
    path = np.array([each.T_wc.t for each in results if each.T_wc is not None])
    assert len(path) == count
    assert len({each.sub_map for each in results}) == 1
    x, z = 0.01 * np.loadtxt(folder / "truth_xz_cm.csv", delimiter=",", skiprows=1)[:count].T
    truth = np.stack([x, np.zeros(count), z], -1)
    T_truth = align(path, truth, with_scale=True).T_target_source
    assert np.sqrt(np.mean(np.sum((T_truth.apply(path) - truth) ** 2, 1))) < 0.01
