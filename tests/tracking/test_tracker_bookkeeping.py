"""The tracker's bookkeeping, with matches that are told the truth: every frame comes out once."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import InitialisationConfig, TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.tracking import tracker as tracker_module
from aquaflow.tracking.frames import BOUNDS, Bound, FrameClass, Wait
from aquaflow.tracking.initialisation.back_fill import BackFill
from aquaflow.tracking.tracker import Tracker
from tests.tracking.tracked_clips import (
    PLACED,
    QUICK,
    SMALL,
    error_share,
    path,
    plane_depth,
    run,
    told,
)
from tests.tracking.tracking_scenes import (
    KnownPrior,
    KnownView,
    SeaFloor,
    depth_map,
    filmed,
    pose,
)


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
    """But the first of them wait for a replay's last look, and keep the reason."""
    monkeypatch.setitem(BOUNDS, Wait.FOR_A_KEYFRAME, Bound(3, "no parallax yet"))
    monkeypatch.setattr(tracker_module, "LAST_LOOKS", 1)
    prior = told(path(8), blind=range(8))
    tracker = Tracker(prior, KeyframeStore(), QUICK)
    given_up = [[t.frame.index for t in tracker.track(f).frames] for f in prior.frames(SMALL)]
    assert given_up == [[], [], [], [], [], [1], [2], [3]]
    last = {t.frame.index: t.reason for t in tracker.finish().frames}
    assert sorted(last) == [0, 4, 5, 6, 7]
    assert last[0] == "no parallax yet"


def test_a_lost_frame_is_looked_for_once_more_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where keyframes on both sides of it are known; here neither tracking nor back-fill did."""
    poses = [pose((0.0, 0.0, 0.0), (0.06 * i, 0.02 * i, 0.0)) for i in range(7)]
    tracker = Tracker(ClassicalPrior(), KeyframeStore(), TrackingConfig())
    follow = tracker._follow
    monkeypatch.setattr(
        tracker, "_follow", lambda frame, *rest: None if frame.index == 5 else follow(frame, *rest)
    )
    monkeypatch.setattr(BackFill, "_place", lambda self, frame: None)
    tracked = [t for f in filmed(SeaFloor(), poses) for t in tracker.track(f).frames]
    assert 5 not in {t.frame.index for t in tracked}
    tracked += tracker.finish().frames
    assert sorted(t.frame.index for t in tracked) == list(range(7))
    assert all(t.T_wc is not None for t in tracked)
    assert error_share(tracked, poses) < 0.02


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

    def wrong(
        a: KnownView, b: KnownView, predicted: np.ndarray | None = None, alone: bool = False
    ) -> object:
        pair = decode(a, b, predicted, alone)
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
