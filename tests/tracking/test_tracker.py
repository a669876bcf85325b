"""The tracker end to end on rendered pictures."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import InitialisationConfig, TrackingConfig
from aquaflow.keyframes import KeyframeStore
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.tracking.frames import FrameClass
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame
from tests.tracking.tracked_clips import PLACED, Run, error_share, run
from tests.tracking.tracking_scenes import CAMERA, SeaFloor, black, filmed, lawn_path, pose

FRAMES = 18
POSES = lawn_path(FRAMES, step_m=0.12)
BLACKOUT = range(8, 11)


@pytest.fixture(scope="module")
def clip() -> list[Frame]:
    return filmed(SeaFloor(), POSES)


@pytest.fixture(scope="module")
def swim(clip: list[Frame]) -> Run:
    return run(clip)


@pytest.fixture(scope="module")
def blacked_out(clip: list[Frame]) -> Run:
    return run([black(f.index) if f.index in BLACKOUT else f for f in clip])


# --- rendered pictures ----------------------------------------------------------------------------


def test_every_frame_of_a_clean_swim_is_placed_within_a_percent_of_the_path(swim: Run) -> None:
    assert all(t.T_wc is not None and t.frame_class in PLACED for t in swim.tracked)
    assert error_share(swim.tracked, POSES) < 0.01
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
        known = tracked.pointmap.is_known(0.15)
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
    assert error_share(before, POSES) < 0.01
    assert error_share(after, POSES) < 0.01
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
    assert error_share(result.tracked, POSES) < 0.01


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


def test_a_dive_that_begins_in_the_middle_of_a_swing_starts_from_one_of_its_ends() -> None:
    """From the middle neither end has the parallax that a start needs; between the ends it is."""
    right, left = [0.0, 0.3, 0.5, 0.3], [0.0, -0.2, -0.3, -0.2]
    swing = [pose((0.0, 0.0, 0.0), (x, 0.0, 0.0)) for x in [*right, *left] * 2 + right]
    config = TrackingConfig(initialisation=InitialisationConfig(parallax_widths=0.025))
    tracker = Tracker(ClassicalPrior(), KeyframeStore(), config)
    tracked = [each for frame in filmed(SeaFloor(), swing) for each in tracker.track(frame).frames]
    assert sum(each.T_wc is not None for each in tracked) == len(swing)


@pytest.mark.filterwarnings("error")
def test_a_black_clip_is_lost_and_raises_nothing() -> None:
    result = run([black(i) for i in range(6)])
    assert {t.frame_class for t in result.tracked} == {FrameClass.LOST}
    assert len(result.store) == 0


def test_no_frames_at_all_are_no_frames() -> None:
    assert run([]).tracked == []
