"""Wide steps: rival poses where the picture repeats, new depth after a turn, other keyframes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aquaflow.config import TrackingConfig
from aquaflow.geometry.similarity import Sim3, so3_log
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.contract import Keypoints
from aquaflow.prior.flow_pair import FlowPair
from aquaflow.tracking.current_keyframe import CurrentKeyframe, KeyframeTracker
from aquaflow.tracking.pose.matcher import KeyframeMatcher, Visibility
from aquaflow.tracking.wide_steps import WideSteps, keypoint_poses
from aquaflow.types import Frame
from tests.tracking.tracked_clips import error_share, run
from tests.tracking.tracking_scenes import CAMERA, SeaFloor, black, filmed, pose

FLOOR, PRIOR = SeaFloor(), ClassicalPrior()
HERE = Sim3.identity()


def keyframe_at(T_wc: Sim3, store: KeyframeStore, known: np.ndarray | None = None) -> Keyframe:
    """A keyframe whose depths are true, where they are ``known``."""
    rho = 1.0 / FLOOR.depth(T_wc)
    variance = (0.01 * rho) ** 2
    if known is not None:
        nothing = Pointmap.unknown(CAMERA)
        rho = np.where(known, rho, nothing.rho)
        variance = np.where(known, variance, nothing.variance)
    encoding = PRIOR.encode(FLOOR.picture(T_wc), CAMERA)
    return store.add(0, 0, encoding, T_wc, Pointmap(CAMERA, rho, variance), 0)


def shift_px(found: Sim3, truth: Sim3) -> float:
    """Median distance between where two poses put the keyframe's points."""
    points = CAMERA.unproject(CAMERA.pixel_centres()) * FLOOR.depth(HERE)[..., None]
    a, b = (CAMERA.project(T.apply(points.reshape(-1, 3))) for T in (found, truth))
    return float(np.median(np.linalg.norm(a - b, axis=1)))


def turn_deg(found: Sim3, truth: Sim3) -> float:
    """Angle between two attitudes."""
    return float(np.degrees(np.linalg.norm(so3_log(found.R @ truth.R.T))))


# --- hypotheses from keypoints --------------------------------------------------------------------


def test_two_sets_of_keypoints_that_contradict_each_other_give_both_poses() -> None:
    store = KeyframeStore()
    keyframe = keyframe_at(HERE, store)
    rng = np.random.default_rng(0)
    pixels = rng.uniform((5, 5), (235, 175), (90, 2)).astype(np.float32)
    descriptors = rng.normal(size=(90, 128)).astype(np.float32)
    many, few = pose((0.0, 0.05, 0.0), (0.2, 0.0, 0.0)), pose((0.0, 0.05, 0.0), (-0.15, 0.1, 0.0))
    depth = FLOOR.depth(HERE)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    points = CAMERA.unproject(pixels.astype(np.float64)) * depth[:, None]
    there = np.where(
        np.arange(90)[:, None] < 60,
        CAMERA.project(many.apply(points)),
        CAMERA.project(few.apply(points)),
    ).astype(np.float32)
    frame = PRIOR.encode(FLOOR.picture(HERE), CAMERA)
    keyframe.encoding.keypoints = Keypoints(pixels, descriptors)  # type: ignore[misc]
    frame.keypoints = Keypoints(there, descriptors)
    found = keypoint_poses(keyframe, frame, CAMERA, 0.15)
    assert len(found) == 2
    assert shift_px(found[0], many) < 1.0
    assert shift_px(found[1], few) < 1.0


def test_keypoints_of_nothing_give_no_pose() -> None:
    keyframe = keyframe_at(HERE, KeyframeStore())
    nothing = PRIOR.encode(black(0).image, CAMERA)
    assert keypoint_poses(keyframe, nothing, CAMERA, 0.15) == []


# --- rivals ---------------------------------------------------------------------------------------


def tiled(shift: float) -> np.ndarray:
    """[H, W, 3] equal tiles of 24 px with some stains, moved by ``shift`` px."""
    rng = np.random.default_rng(5)
    x = np.arange(CAMERA.width + 200)
    grid = np.full((CAMERA.height, len(x)), 170.0)
    grid[:, x % 24 < 3] = 60.0
    grid[np.arange(CAMERA.height) % 24 < 3] = 60.0
    for u, v in rng.uniform((0, 0), (len(x), CAMERA.height), (120, 2)).astype(int):
        grid[v : v + 7, u : u + 7] -= rng.uniform(30.0, 60.0)
    start = 100 + round(shift)
    seen = np.clip(grid[:, start : start + CAMERA.width], 0, 255).astype(np.uint8)
    return np.repeat(seen[..., None], 3, axis=2)


def test_of_two_poses_a_tile_apart_the_one_that_stains_speak_for_is_taken() -> None:
    store, config = KeyframeStore(), TrackingConfig()
    rho = np.full((CAMERA.height, CAMERA.width), 0.5)
    plane = Pointmap(CAMERA, rho, (0.01 * rho) ** 2)
    keyframe = store.add(0, 0, PRIOR.encode(tiled(0.0), CAMERA), HERE, plane, 0)
    at = CurrentKeyframe(keyframe)
    at.motion = pose((0.0, 0.0, 0.0), (-0.25, 0.0, 0.0))
    frame = PRIOR.encode(tiled(24.0), CAMERA)
    tracker = KeyframeTracker(PRIOR, store, config)
    solved = tracker.place(at, frame, CAMERA)
    assert solved is not None
    assert solved.estimate.T.t[0] == pytest.approx(-24.0 / 200.0 * 2.0, abs=0.02)


def test_a_sure_pose_has_no_rival() -> None:
    store, config = KeyframeStore(), TrackingConfig()
    keyframe = keyframe_at(HERE, store)
    T_wc = pose((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    frame = PRIOR.encode(FLOOR.picture(T_wc), CAMERA)
    tracker = KeyframeTracker(PRIOR, store, config)
    solved = tracker.place(CurrentKeyframe(keyframe), frame, CAMERA)
    assert solved is not None
    wide = WideSteps(PRIOR, tracker._matcher, config)
    assert not wide.doubtful(keyframe, solved, HERE, T_wc.inverse(), CAMERA)
    assert wide.doubtful(keyframe, None, HERE, HERE, CAMERA)


def test_of_two_poses_that_one_wins_which_explains_what_it_puts_into_view(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Between tiles, the pose that is one of them off may have more matches."""
    store, config = KeyframeStore(), TrackingConfig()
    keyframe = keyframe_at(HERE, store)
    frame = PRIOR.encode(FLOOR.picture(pose((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))), CAMERA)
    tracker = KeyframeTracker(PRIOR, store, config)
    right = tracker.place(CurrentKeyframe(keyframe), frame, CAMERA)
    assert right is not None
    unsure = replace(right.estimate, inlier_share=0.7)
    right = replace(right, estimate=unsure, share=0.40, visibility=Visibility(0.5, 0.95))
    wrong = replace(right, estimate=unsure, share=0.48, visibility=Visibility(0.9, 0.5))
    assert wrong.support > right.support
    for first, second in ((right, wrong), (wrong, right)):
        matcher = KeyframeMatcher(config)
        monkeypatch.setattr(matcher, "pose", lambda *_, it=second: it)
        wide = WideSteps(PRIOR, matcher, config)
        assert wide.best(keyframe, keyframe.encoding, frame, CAMERA, first, HERE) is right


# --- depth after a turn ---------------------------------------------------------------------------


def test_what_a_turn_has_just_brought_into_view_gets_its_depth_from_the_next_step() -> None:
    store, config = KeyframeStore(), TrackingConfig()
    known = np.zeros((CAMERA.height, CAMERA.width), bool)
    T_wc = pose((0.0, 0.45, 0.0), (0.25, 0.05, 0.0))
    frame = PRIOR.encode(FLOOR.picture(T_wc), CAMERA)
    keyframe = keyframe_at(HERE, store, known)
    at = CurrentKeyframe(keyframe)
    at.motion = T_wc.inverse()
    tracker = KeyframeTracker(PRIOR, store, config)
    assert tracker.place(at, frame, CAMERA) is None
    solved = tracker.place_after_turn(at, frame, CAMERA, None)
    assert solved is not None
    assert shift_px(solved.estimate.T, T_wc.inverse()) < 3.0
    assert keyframe.pointmap.is_known(0.15).mean() > 0.1


def test_a_turn_that_no_keypoint_shows_is_followed_where_the_motion_so_far_leads() -> None:
    store, config = KeyframeStore(), TrackingConfig()
    T_wc = pose((0.0, 0.45, 0.0), (0.25, 0.05, 0.0))
    frame = PRIOR.encode(FLOOR.picture(T_wc), CAMERA)
    frame.keypoints = Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    at = CurrentKeyframe(keyframe_at(HERE, store, np.zeros((CAMERA.height, CAMERA.width), bool)))
    at.motion = pose((0.0, 0.42, 0.0), (0.25, 0.05, 0.0)).inverse()
    tracker = KeyframeTracker(PRIOR, store, config)
    solved = tracker.place_after_turn(at, frame, CAMERA, None)
    assert solved is not None
    assert shift_px(solved.estimate.T, T_wc.inverse()) < 3.0


@pytest.mark.parametrize(("confidence", "found"), [(0.05, True), (0.005, False)])
def test_matches_that_agree_by_chance_give_no_depth_after_a_turn(
    confidence: float, found: bool
) -> None:
    store, T_wc = KeyframeStore(), pose((0.0, 0.45, 0.0), (0.25, 0.05, 0.0))

    def decode(*given: Any, **named: Any) -> FlowPair:
        pair = PRIOR.decode(*given, **named)
        pair.C = np.full_like(pair.C, confidence)
        return pair

    prior: Any = SimpleNamespace(decode=decode, encode=PRIOR.encode)
    at = CurrentKeyframe(keyframe_at(HERE, store, np.zeros((CAMERA.height, CAMERA.width), bool)))
    at.motion = T_wc.inverse()
    tracker = KeyframeTracker(prior, store, TrackingConfig())
    frame = PRIOR.encode(FLOOR.picture(T_wc), CAMERA)
    rough = tracker.place(CurrentKeyframe(keyframe_at(HERE, store)), frame, CAMERA)
    assert rough is not None
    for solved in (None, replace(rough, known_share=0.01)):
        assert (tracker.place_after_turn(at, frame, CAMERA, solved) is not None) == found


@pytest.mark.parametrize(("off_px", "found"), [(0.0, True), (24.0, False)])
def test_a_step_that_keypoints_of_known_depth_deny_is_none(off_px: float, found: bool) -> None:
    """Matches that are tiles off all the way agree with each other, not with what has no double."""
    store, T_wc = KeyframeStore(), pose((0.0, 0.45, 0.0), (0.25, 0.05, 0.0))
    known = np.zeros((CAMERA.height, CAMERA.width), bool)
    known[:40, :40] = True
    keyframe = keyframe_at(HERE, store, known)
    rng = np.random.default_rng(0)
    pixels = rng.uniform((1, 1), (39, 39), (30, 2)).astype(np.float32)
    descriptors = rng.normal(size=(30, 128)).astype(np.float32)
    depth = FLOOR.depth(HERE)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    points = CAMERA.unproject(pixels.astype(np.float64)) * depth[:, None]
    there = CAMERA.project(T_wc.inverse().apply(points)) + np.array([off_px, 0.0])
    frame = PRIOR.encode(FLOOR.picture(T_wc), CAMERA)
    keyframe.encoding.keypoints = Keypoints(pixels, descriptors)  # type: ignore[misc]
    frame.keypoints = Keypoints(there.astype(np.float32), descriptors)
    at = CurrentKeyframe(keyframe)
    at.motion = T_wc.inverse()
    tracker = KeyframeTracker(PRIOR, store, TrackingConfig())
    assert (tracker.place_after_turn(at, frame, CAMERA, None) is not None) == found


def test_a_pose_from_the_rim_of_what_is_known_is_replaced_after_a_turn() -> None:
    """One corner has depths, which are 10 % off: where that leads to, the rest does not fit."""
    store, config = KeyframeStore(), TrackingConfig()
    known = np.zeros((CAMERA.height, CAMERA.width), bool)
    known[20:44, 190:214] = True
    T_wc = pose((0.0, 0.45, 0.0), (0.25, 0.05, 0.0))
    frame = PRIOR.encode(FLOOR.picture(T_wc), CAMERA)
    keyframe = keyframe_at(HERE, store, known)
    keyframe.pointmap.rho *= 1.0 + np.linspace(-0.1, 0.1, CAMERA.width * 4)[: CAMERA.width]
    at = CurrentKeyframe(keyframe)
    at.motion = T_wc.inverse()
    tracker = KeyframeTracker(PRIOR, store, config)
    rough = tracker.place(at, frame, CAMERA)
    assert rough is not None
    solved = tracker.place_after_turn(at, frame, CAMERA, rough)
    assert solved is not None
    assert rough.known_share < config.least_known_share < solved.known_share
    turned, rough_turned = (turn_deg(m.estimate.T, T_wc.inverse()) for m in (solved, rough))
    assert turned < 0.1 < 0.5 * rough_turned


def test_a_pose_from_a_known_view_stays_as_it_is() -> None:
    store = KeyframeStore()
    T_wc = pose((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    at = CurrentKeyframe(keyframe_at(HERE, store))
    frame = PRIOR.encode(FLOOR.picture(T_wc), CAMERA)
    tracker = KeyframeTracker(PRIOR, store, TrackingConfig())
    solved = tracker.place(at, frame, CAMERA)
    assert solved is not None
    assert solved.known_share > 0.9
    assert tracker.place_after_turn(at, frame, CAMERA, solved) is solved


# --- other keyframes ------------------------------------------------------------------------------


def test_a_lost_frame_is_looked_for_in_the_keyframes_left_last() -> None:
    far = pose((0.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    store = KeyframeStore()
    first, second = keyframe_at(HERE, store), keyframe_at(far, store)
    tracker = KeyframeTracker(PRIOR, store, TrackingConfig())
    tracker.register(CurrentKeyframe(first))
    back = pose((0.0, 0.0, 0.1), (0.3, 0.1, 0.0))
    there = tracker.recent(
        CurrentKeyframe(second), PRIOR.encode(FLOOR.picture(back), CAMERA), CAMERA
    )
    assert there is not None
    assert there.keyframe is first
    assert shift_px(there.T_fk, back.inverse()) < 1.0
    nowhere = PRIOR.encode(black(0).image, CAMERA)
    assert tracker.recent(CurrentKeyframe(second), nowhere, CAMERA) is None


def wide_path(count: int) -> list[Sim3]:
    """Steps of more than half a view."""
    return [pose((0.0, 0.03 * i, 0.02 * i), (0.95 * i, 0.1 * (i % 3), 0.0)) for i in range(count)]


@pytest.fixture(scope="module")
def wide_clip() -> tuple[list[Sim3], list[Frame]]:
    start = [pose((0.0, 0.0, 0.0), (0.12 * i, 0.02 * i, 0.0)) for i in range(5)]
    after = [Sim3(T.R, T.t + start[-1].t) for T in wide_path(6)[1:]]
    poses = start + after
    return poses, filmed(FLOOR, poses)


def test_steps_of_half_a_view_stay_in_one_map(
    wide_clip: tuple[list[Sim3], list[Frame]], monkeypatch: pytest.MonkeyPatch
) -> None:
    poses, frames = wide_clip
    result = run(frames)
    assert all(t.T_wc is not None for t in result.tracked)
    assert {t.sub_map for t in result.tracked} == {0}
    assert error_share(result.tracked, poses) < 0.06
    monkeypatch.setattr(KeyframeTracker, "place_after_turn", lambda *given: given[-1])
    without = run(frames)
    assert any(t.T_wc is None for t in without.tracked) or without.tracker.sub_maps > 1


# --- the motion that is expected ------------------------------------------------------------------

STEP = np.array([0.02, 0.0, 0.01, 0.0, 0.01, 0.0, 0.0])


@pytest.mark.parametrize(
    ("t_ns", "times"), [(300, 1.0), (400, 2.0), (600, 4.0), (10_000, 1.0), (100, 1.0)]
)
def test_the_last_motion_is_expected_again_for_as_long_as_the_time_since(
    t_ns: int, times: float
) -> None:
    keyframe = keyframe_at(HERE, KeyframeStore())
    at = CurrentKeyframe(keyframe, motion=Sim3.exp(STEP), t_ns=200, interval_ns=100)
    at.expect(t_ns, None)
    np.testing.assert_allclose(at.motion.log(), times * STEP, atol=1e-9)


def test_a_frame_without_a_pose_stretches_the_motion_no_more_than_the_time() -> None:
    keyframe = keyframe_at(HERE, KeyframeStore())
    at = CurrentKeyframe(keyframe, motion=Sim3.exp(STEP), t_ns=200, interval_ns=100)
    at.expect(300, None)
    at.expect(400, None)
    np.testing.assert_allclose(at.motion.log(), 2.0 * STEP, atol=1e-9)


def test_a_wide_step_like_the_last_one_needs_one_flow_and_no_keypoints() -> None:
    store = KeyframeStore()
    step = pose((0.0, 0.0, 0.0), (-0.6, 0.0, 0.0))
    at = CurrentKeyframe(keyframe_at(HERE, store), motion=step)
    frame = PRIOR.encode(FLOOR.picture(step.inverse()), CAMERA)
    solved = KeyframeTracker(PRIOR, store, TrackingConfig()).place(at, frame, CAMERA)
    assert solved is not None
    assert shift_px(solved.estimate.T, step) < 0.5
    assert "keypoints" not in vars(frame)
