"""What a start left wrong in poses and depths is solved again when its first keyframe is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.config import Config, TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.slam import Slam
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.tracking.initialisation.initialiser import Initialised, Initialiser, fused_pointmap
from aquaflow.tracking.initialisation.second_solution import SecondSolution
from aquaflow.tracking.pose.matcher import Matched, Visibility
from aquaflow.tracking.pose.solver import PoseProblem, solve_pose
from aquaflow.types import Frame
from tests.tracking.tracking_scenes import (
    KnownPair,
    KnownPrior,
    KnownView,
    SeaFloor,
    depth_map,
    filmed,
    lawn_path,
    pose,
)

CAMERA = CameraModel(96, 72, 80.0, 80.0, 48.0, 36.0)
CONFIG = TrackingConfig()
ALONG = [pose((0.0, 0.01 * i, 0.0), (0.05 * i, 0.0, 0.01 * i)) for i in range(9)]
TILT = so3_exp(np.array([0.0, 0.04, 0.04]))
"""Of the direction of motion: 3.2 degrees."""


def bent(T_fk: Sim3) -> Sim3:
    """A pose as a start leaves it that has the direction of motion wrong."""
    return Sim3(T_fk.R, TILT @ T_fk.t)


class BentStart:
    """A keyframe whose depths were triangulated from wrong poses, and frames posed against them."""

    def __init__(self, poses: list[Sim3], noise_px: float = 0.0) -> None:
        views = [KnownView(CAMERA, T, depth_map(CAMERA, flat=False)) for T in poses]
        prior = KnownPrior(views, CAMERA, noise_px)
        self.true = [T.inverse() for T in poses]
        self.pairs = [KnownPair(views[0], view, noise_px, CAMERA) for view in views[1:]]
        self.depth = views[0].depth
        rays = CAMERA.unproject(CAMERA.pixel_centres())
        last = bent(self.true[-1])
        pointmap = Pointmap.unknown(CAMERA)
        pointmap.rho[:] = triangulated(rays, self.pairs[-1].matches, last)
        pointmap.variance[:] = (0.01 * pointmap.rho) ** 2
        encoding = prior.encode(np.zeros((2, 2, 3), np.uint8), CAMERA)
        self.keyframe: Keyframe = KeyframeStore().add(0, 0, encoding, Sim3.identity(), pointmap, 0)
        self.matched = [
            placed(self.keyframe, pair, bent(T))
            for pair, T in zip(self.pairs, self.true[1:], strict=True)
        ]

    def off(self, T_kf: Sim3, view: int) -> float:
        """Angle between the direction to a camera and the true one, in rad."""
        found, true = T_kf.t, self.true[view].inverse().t
        return float(np.arccos(found @ true / np.linalg.norm(found) / np.linalg.norm(true)))


def triangulated(
    rays: npt.NDArray[np.float64],  # [H, W, 3]
    matches: npt.NDArray[np.float32],  # [H, W, 2] px
    T: Sim3,
) -> npt.NDArray[np.float64]:
    """[H, W] inverse depths that fit matches to a frame at ``T`` best."""
    seen = CAMERA.unproject(matches.astype(np.float64))
    way, value = np.cross(seen, T.t), np.cross(seen, rays @ T.R.T)
    return np.asarray(-(way * value).sum(-1) / (way**2).sum(-1))


def placed(keyframe: Keyframe, pair: KnownPair, guess: Sim3) -> Matched:
    """The frame's pose against the keyframe's depths as they are."""
    rows, columns = (part[::7] for part in np.nonzero(pair.valid))
    pixels = np.stack([columns + 0.5, rows + 0.5], -1)
    rho = keyframe.pointmap.rho[rows, columns, None]
    points, one = CAMERA.unproject(pixels) / rho, np.ones(len(rows))
    seen = pair.matches[rows, columns].astype(np.float64)
    estimate = solve_pose(PoseProblem(points, 0.0 * one, seen, one, CAMERA, 0.5), guess)
    assert estimate is not None
    return Matched(estimate, pair, 1.0, 10.0, points, Visibility(1.0, 1.0), 1.0)


def depth_error(keyframe: Keyframe, depth: npt.NDArray[np.float64]) -> float:
    """Median departure of the depths' ratio to the true ones from its own median."""
    ratio = np.log(keyframe.pointmap.rho * depth)
    return float(np.median(np.abs(ratio - np.median(ratio))))


def test_the_direction_of_motion_and_the_shape_of_depths_come_out_right() -> None:
    start = BentStart(ALONG)
    second, before = (
        SecondSolution(start.keyframe, CONFIG),
        depth_error(start.keyframe, start.depth),
    )
    for matched in start.matched:
        second.take(matched)
    found = second.solve(len(ALONG))
    assert found is not None
    assert before > 0.001
    assert depth_error(start.keyframe, start.depth) < 0.2 * before
    for view, matched in enumerate(start.matched, start=1):
        wrong = matched.estimate.T.inverse()
        assert start.off(wrong, view) > 0.01
        assert start.off(found.correct(wrong), view) < 0.4 * start.off(wrong, view)


def test_the_keyframe_keeps_its_unit() -> None:
    start = BentStart(ALONG)
    second, before = SecondSolution(start.keyframe, CONFIG), start.keyframe.pointmap.rho.copy()
    for matched in start.matched:
        second.take(matched)
    assert second.solve(len(ALONG)) is not None
    growth = np.log(start.keyframe.pointmap.rho / before)
    assert abs(float(np.median(growth))) < 0.01


def test_a_pose_at_the_keyframe_itself_stays() -> None:
    start = BentStart(ALONG)
    second = SecondSolution(start.keyframe, CONFIG)
    for matched in start.matched:
        second.take(matched)
    found = second.solve(len(ALONG))
    assert found is not None
    np.testing.assert_array_equal(found.correct(Sim3.identity()).matrix, np.eye(4))


def test_across_a_straight_way_nothing_is_changed() -> None:
    start = BentStart([pose((0.0, 0.0, 0.0), (0.05 * i, 0.0, 0.0)) for i in range(9)])
    second = SecondSolution(start.keyframe, CONFIG)
    for matched in start.matched:
        second.take(matched)
    found = second.solve(9)
    assert found is not None
    aside = Sim3(np.eye(3), TILT.T @ np.array([0.0, 0.3, 0.0]))
    assert np.linalg.norm((found.correct(aside).inverse() @ aside).log()) < 1e-3


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_frames_change_nothing(count: int) -> None:
    start = BentStart(ALONG)
    second, before = SecondSolution(start.keyframe, CONFIG), start.keyframe.pointmap.copy()
    for matched in start.matched[:count]:
        second.take(matched)
    assert second.solve(len(ALONG)) is None
    np.testing.assert_array_equal(start.keyframe.pointmap.rho, before.rho)


def test_frames_that_never_moved_change_nothing() -> None:
    start = BentStart(ALONG)
    second, before = SecondSolution(start.keyframe, CONFIG), start.keyframe.pointmap.copy()
    for matched in start.matched[:4]:
        still = replace(matched.estimate, T=Sim3.identity())
        second.take(replace(matched, estimate=still))
    second.solve(len(ALONG))
    assert np.isfinite(start.keyframe.pointmap.rho).all()
    assert np.abs(np.log(start.keyframe.pointmap.rho / before.rho)).max() < 1.0


def test_only_frames_posed_before_are_carried_over() -> None:
    start = BentStart(ALONG)
    second = SecondSolution(start.keyframe, CONFIG)
    for matched in start.matched:
        second.take(matched)
    found = second.solve(5)
    assert found is not None
    picture = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    for index, keyframe, concerned in ((4, 0, True), (5, 0, False), (4, 1, False)):
        frame = Frame(index, 0, 0, picture, CAMERA)
        assert found.concerns(Tracked(frame, FrameClass.COMMON, 0, keyframe)) is concerned


# --- in a dive ------------------------------------------------------------------------------------

POSES = lawn_path(30, step_m=0.05)


@pytest.fixture(scope="module")
def clip() -> list[Frame]:
    return filmed(SeaFloor(), POSES)


def turned_off(clip: list[Frame], monkeypatch: pytest.MonkeyPatch) -> float:
    """Mean angle in rad between the steps of a dive and the true ones, turned by its first frame,
    where the start has the direction of motion wrong."""
    solve = Initialiser.solve

    def solve_wrong(self: Initialiser) -> Initialised | None:
        found = solve(self)
        if found is None:
            return None
        wrong = replace(found, T=[bent(T) for T in found.T])
        pointmap = fused_pointmap(wrong, wrong.camera, CONFIG.sigma_px)
        assert (pointmap.rho > 0.0).any()
        return wrong

    monkeypatch.setattr(Initialiser, "solve", solve_wrong)
    slam = Slam(Config.model_validate({"mapping": {"enabled": False}}))
    for frame in clip:
        slam.process(frame)
    slam.finish()
    slam.close()
    tracked = {each.frame.index: each.T_wc for each in slam.results() if each.T_wc is not None}
    assert len(tracked) == len(clip)
    angles = []
    for index in range(6, len(clip)):
        found = tracked[index].t - tracked[0].t
        true = POSES[0].R.T @ (POSES[index].t - POSES[0].t)
        cosine = found @ true / np.linalg.norm(found) / np.linalg.norm(true)
        angles.append(float(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return float(np.mean(angles))


def test_a_dive_recovers_from_a_start_with_a_wrong_direction(
    clip: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    recovered = turned_off(clip, monkeypatch)
    monkeypatch.setattr(SecondSolution, "solve", lambda *_: None)
    left = turned_off(clip, monkeypatch)
    assert left > 0.01
    assert recovered < 0.4 * left
