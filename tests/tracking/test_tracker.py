"""The tracker end to end on rendered pictures, and its bookkeeping: every frame comes out once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from tracking_scenes import (
    CAMERA,
    KnownPrior,
    KnownView,
    SeaFloor,
    black,
    depth_map,
    filmed,
    lawn_path,
    pose,
)

from aquaflow.config import InitialisationConfig, TrackingConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.messages import Frame
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.contract import Prior
from aquaflow.tracking import tracker as module
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.tracking.tracker import Tracker

FRAMES = 18
POSES = lawn_path(FRAMES, step_m=0.12)
BLACKOUT = range(8, 11)
PLACED = {FrameClass.KEYFRAME, FrameClass.MAPPING, FrameClass.COMMON}


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
        tracked += tracker.track(frame)
    tracked += tracker.finish()
    # Whatever happens in between: every frame comes out exactly once.
    assert sorted(t.frame.index for t in tracked) == sorted(f.index for f in frames)
    return Run(tracked, store, tracker)


@pytest.fixture(scope="module")
def clip() -> list[Frame]:
    return filmed(SeaFloor(), POSES)


@pytest.fixture(scope="module")
def swim(clip: list[Frame]) -> Run:
    return run(clip)


@pytest.fixture(scope="module")
def blacked_out(clip: list[Frame]) -> Run:
    return run([black(f.index) if f.index in BLACKOUT else f for f in clip])


def error_share(tracked: Sequence[Tracked], poses: Sequence[Sim3] = POSES) -> float:
    """RMSE of the positions after a Sim(3) alignment, over the length of the path."""
    placed = [(t.frame.index, t.T_wc.t) for t in tracked if t.T_wc is not None]
    found = np.array([t for _, t in sorted(placed, key=lambda item: item[0])])
    truth = np.array([poses[index].t for index in sorted(index for index, _ in placed)])
    moved = align(found, truth, with_scale=True).T_target_source.apply(found)
    length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(np.sqrt(((moved - truth) ** 2).sum(1).mean()) / length)


# --- rendered pictures ----------------------------------------------------------------------------


def test_every_frame_of_a_clean_swim_is_placed_within_a_percent_of_the_path(swim: Run) -> None:
    assert all(t.T_wc is not None and t.frame_class in PLACED for t in swim.tracked)
    assert error_share(swim.tracked) < 0.01
    assert {t.sub_map for t in swim.tracked} == {0}


def test_orientations_are_right_too(swim: Run) -> None:
    turns = []
    for tracked in swim.tracked:
        assert tracked.T_wc is not None
        relative = POSES[0].inverse() @ POSES[tracked.frame.index]
        turns.append(np.linalg.norm((relative.inverse() @ tracked.T_wc).log()[3:6]))
    assert np.max(turns) < 0.02


def test_the_first_frame_is_the_world(swim: Run) -> None:
    first = swim.by_index()[0]
    assert first.frame_class is FrameClass.KEYFRAME
    assert first.T_wc is not None
    np.testing.assert_array_equal(first.T_wc.matrix, np.eye(4))


def test_a_frame_that_matches_too_little_becomes_a_keyframe_and_only_that(swim: Run) -> None:
    share = TrackingConfig().keyframe_share
    later = [t for t in swim.tracked if t.frame.index != 0]
    for tracked in later:
        few = tracked.quality.matched_share < share
        assert (tracked.frame_class is FrameClass.KEYFRAME) is few
    assert len(swim.store) >= 3
    assert {t.frame_class for t in later} == PLACED


def test_keyframes_in_the_store_are_the_frames_called_keyframes(swim: Run) -> None:
    called = [t for t in swim.tracked if t.frame_class is FrameClass.KEYFRAME]
    assert [k.frame_index for k in swim.store.keyframes] == [t.frame.index for t in called]
    for tracked in called:
        assert tracked.keyframe is not None
        keyframe = swim.store[tracked.keyframe]
        assert tracked.T_wc is not None
        np.testing.assert_allclose(keyframe.T_wc.matrix, tracked.T_wc.matrix)
        assert keyframe.t_ns == tracked.frame.t_ns


def test_only_frames_for_the_map_carry_a_pointmap_and_it_is_right(swim: Run) -> None:
    floor = SeaFloor()
    scale = 1.0 / np.median(floor.depth(POSES[0]))
    for tracked in swim.tracked:
        if tracked.frame_class is FrameClass.COMMON:
            assert tracked.pointmap is None
            continue
        assert tracked.pointmap is not None
        known = tracked.pointmap.known(0.15)
        truth = floor.depth(POSES[tracked.frame.index]) * scale
        ratio = 1.0 / tracked.pointmap.rho[known] / truth[known]
        assert known.mean() > 0.3
        assert np.median(np.abs(ratio / np.median(ratio) - 1.0)) < 0.02


def test_the_quality_of_a_good_pose_is_good(swim: Run) -> None:
    for tracked in swim.tracked[1:]:
        assert tracked.quality.inlier_share > 0.8
        assert tracked.quality.residual_px < 0.5
        assert tracked.quality.conditioning > 1e-4


def test_frames_come_out_in_the_order_they_went_in(swim: Run) -> None:
    indices = [t.frame.index for t in swim.tracked]
    assert indices == sorted(indices)


def test_the_same_clip_gives_the_same_poses_bit_for_bit(clip: list[Frame]) -> None:
    first, second = run(clip[:9]), run(clip[:9])
    for a, b in zip(first.tracked, second.tracked, strict=True):
        assert a.frame_class is b.frame_class
        assert (a.T_wc is None) == (b.T_wc is None)
        if a.T_wc is not None and b.T_wc is not None:
            np.testing.assert_array_equal(a.T_wc.matrix, b.T_wc.matrix)


def test_a_blackout_costs_its_frames_and_starts_a_new_sub_map(blacked_out: Run) -> None:
    for index, tracked in blacked_out.by_index().items():
        if index in BLACKOUT:
            assert tracked.frame_class is FrameClass.LOST
            assert tracked.T_wc is None
            assert tracked.reason
        else:
            assert tracked.frame_class in PLACED
            assert tracked.sub_map == (0 if index < BLACKOUT.start else 1)


def test_both_sub_maps_are_right_and_the_second_starts_where_the_first_ended(
    blacked_out: Run,
) -> None:
    before = [t for t in blacked_out.tracked if t.frame.index < BLACKOUT.start]
    after = [t for t in blacked_out.tracked if t.frame.index >= BLACKOUT.stop]
    assert error_share(before) < 0.01
    assert error_share(after) < 0.01
    last, first = before[-1].T_wc, min(after, key=lambda t: t.frame.index).T_wc
    assert last is not None
    assert first is not None
    np.testing.assert_allclose(first.matrix, last.matrix, atol=1e-9)


def test_a_loss_shorter_than_the_limit_stays_in_the_sub_map(clip: list[Frame]) -> None:
    gap = (9, 10)
    result = run([black(f.index) if f.index in gap else f for f in clip[:14]])
    lost = [t.frame.index for t in result.tracked if t.frame_class is FrameClass.LOST]
    assert lost == [9, 10]
    assert {t.sub_map for t in result.tracked} == {0}
    assert error_share(result.tracked) < 0.01


def test_a_clip_that_ends_in_the_dark_accounts_for_the_last_frames(clip: list[Frame]) -> None:
    result = run([*clip[:8], black(8), black(9)])
    assert [t.frame_class for t in result.tracked[-2:]] == [FrameClass.LOST] * 2


def test_three_frames_with_parallax_are_placed_at_the_end(clip: list[Frame]) -> None:
    result = run([clip[0], clip[2], clip[4]])
    assert [t.frame_class in PLACED for t in result.tracked] == [True] * 3


def test_three_frames_without_motion_are_lost_with_a_reason(clip: list[Frame]) -> None:
    still = [Frame(i, i, i, clip[0].image, CAMERA) for i in range(3)]
    result = run(still)
    assert [t.frame_class for t in result.tracked] == [FrameClass.LOST] * 3
    assert all(t.reason == "no pose found" for t in result.tracked)
    assert len(result.store) == 0


@pytest.mark.filterwarnings("error")
def test_a_black_clip_is_lost_and_raises_nothing() -> None:
    result = run([black(i) for i in range(6)])
    assert {t.frame_class for t in result.tracked} == {FrameClass.LOST}
    assert len(result.store) == 0


def test_no_frames_at_all_are_no_frames() -> None:
    assert run([]).tracked == []


# --- bookkeeping, with matches that are told the truth --------------------------------------------

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


def test_the_plane_of_these_tests_is_the_plane_of_the_scenes() -> None:
    np.testing.assert_allclose(plane_depth(Sim3.identity()), depth_map(SMALL, flat=True))


def test_frames_before_the_start_are_filled_in_afterwards() -> None:
    """The third picture is blind: the two before it wait, and are placed once the map has begun."""
    first = [pose((0.0, 0.0, 0.01 * i), (0.0, 0.0, 0.0)) for i in range(3)]
    poses = [*first, *path(13)[3:]]
    prior = told(poses, blind=(2,))
    result = run(prior.frames(SMALL), QUICK, prior).by_index()
    assert result[2].frame_class is FrameClass.LOST
    assert result[3].frame_class is FrameClass.KEYFRAME
    for index in (0, 1):
        assert result[index].frame_class is FrameClass.COMMON
        assert result[index].T_wc is not None
    assert error_share(list(result.values()), poses) < 0.01


def test_thinned_frames_are_filled_in_too() -> None:
    slow = path(14, step=0.02)
    prior = told(slow)
    config = TrackingConfig(
        initialisation=InitialisationConfig(points=400, max_waiting=3, parallax_widths=0.05)
    )
    result = run(prior.frames(SMALL), config, prior)
    assert all(t.T_wc is not None for t in result.tracked)
    assert error_share(result.tracked, slow) < 0.02


def test_frames_that_wait_for_ever_are_given_up_oldest_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MAX_ORPHANS", 3)
    prior = told(path(8), blind=range(8))
    tracker = Tracker(prior, KeyframeStore(), QUICK)
    given_up = [[t.frame.index for t in tracker.track(f)] for f in prior.frames(SMALL)]
    assert given_up == [[], [], [], [], [0], [1], [2], [3]]
    assert sorted(t.frame.index for t in tracker.finish()) == [4, 5, 6, 7]


@pytest.mark.parametrize(("widths", "mapping"), [(1e-4, True), (10.0, False)], ids=["low", "high"])
def test_parallax_since_the_last_mapped_frame_makes_a_mapping_frame(
    widths: float, mapping: bool
) -> None:
    prior = told(path(10, step=0.04))
    config = QUICK.model_copy(update={"mapping_parallax_widths": widths, "keyframe_share": 0.1})
    later = run(prior.frames(SMALL), config, prior).tracked[1:]
    expected = FrameClass.MAPPING if mapping else FrameClass.COMMON
    assert {t.frame_class for t in later} == {expected}


def test_too_few_matches_with_known_depth_are_no_pose() -> None:
    prior = told(path(12))
    everything = QUICK.model_copy(update={"min_matches": 10_000, "matches": 5000})
    result = run(prior.frames(SMALL), everything, prior)
    assert {t.frame_class for t in result.tracked} <= {FrameClass.LOST, FrameClass.KEYFRAME}


def test_a_pose_that_explains_too_few_matches_is_no_pose() -> None:
    """The last two pictures match another place."""
    poses = path(15)
    prior = told(poses)
    decode = prior.decode

    def wrong(a: KnownView, b: KnownView, predicted: np.ndarray | None = None) -> object:
        pair = decode(a, b, predicted)
        if any(b.T_wc is view.T_wc for view in prior.views[13:]):
            pair.matches = (
                np.random.default_rng(0).uniform(3, 69, pair.matches.shape).astype(np.float32)
            )
        return pair

    prior.decode = wrong  # type: ignore[method-assign, assignment]
    result = run(prior.frames(SMALL), QUICK, prior).by_index()
    assert all(result[i].frame_class in PLACED for i in range(13))
    assert all(result[i].frame_class is FrameClass.LOST for i in range(13, 15))


def test_a_pose_is_found_from_scratch_after_a_jump_that_no_prediction_covers() -> None:
    steady = path(9, step=0.05)
    jump = pose((0.1, -0.25, 0.9), (0.05, 0.1, -0.3))
    poses = [*steady, jump]
    prior = told(poses)
    result = run(prior.frames(SMALL), QUICK, prior)
    assert result.by_index()[9].frame_class in PLACED
    assert error_share(result.tracked, poses) < 0.01


def test_an_unknown_focal_length_is_refined_and_reported() -> None:
    poses = [
        pose((0.03 * i, 0.05 * i, -0.06 * i), (0.08 * i, 0.03 * i, 0.05 * i)) for i in range(9)
    ]
    depth = depth_map(SMALL, flat=False)
    prior = KnownPrior([KnownView(SMALL, T, depth) for T in poses], SMALL, noise_px=0.03)
    guess = CameraModel(96, 72, 95.0, 95.0, 48.0, 36.0, calibrated=False)
    config = QUICK.model_copy(update={"keyframe_share": 0.05})
    result = run(prior.frames(guess), config, prior)
    camera = result.tracker.camera
    assert camera is not None
    assert camera.calibrated
    assert camera.fx == pytest.approx(SMALL.fx, rel=0.06)
    assert 0.0 < result.tracker.focal_sigma < 0.05
