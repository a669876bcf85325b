"""Which keyframe is in use: snow makes none, and a place that was left is taken up again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.tracking.frames import FrameClass
from aquaflow.tracking.pose.matcher import KeyframeMatcher
from aquaflow.tracking.pose.solver import PoseEstimate, PoseProblem
from aquaflow.tracking.tracker import Tracker
from aquaflow.tracking.wide_steps import WideSteps
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
from tests.tracking.tracking_scenes import KnownPair, KnownPrior, KnownView, pose

SNOWED = range(6, 12)
HIDDEN = 0.55
"""Share of the matches that snow takes."""


def snowed(poses: Sequence[Sim3], which: Sequence[int]) -> KnownPrior:
    """A prior whose matches onto the frames ``which``, or from them, have holes."""
    prior = told(poses)
    plain, hidden = prior.decode, [prior.views[i].T_wc for i in which]

    def holed(
        a: KnownView, b: KnownView, predicted: np.ndarray | None = None, alone: bool = False
    ) -> KnownPair:
        pair = plain(a, b, predicted, alone)
        rng = np.random.default_rng(len(prior.predictions))
        for view in (a, b):
            if any(view.T_wc is T for T in hidden):
                pair.valid &= rng.random(pair.valid.shape) > HIDDEN
                pair.valid_back &= rng.random(pair.valid.shape) > HIDDEN
        return pair

    prior.decode = holed  # type: ignore[method-assign]
    return prior


def test_what_is_hidden_in_plain_view_makes_no_keyframe() -> None:
    poses = path(16, step=0.02)
    prior = snowed(poses, SNOWED)
    result = run(prior.frames(SMALL), QUICK, prior)
    tracked = result.by_index()
    assert {tracked[i].frame_class for i in SNOWED} == {FrameClass.COMMON}
    assert not {k.frame_index for k in result.store.keyframes} & set(SNOWED)
    assert error_share(result.tracked, poses) < 0.01


def test_the_paper_makes_a_keyframe_of_what_is_hidden() -> None:
    poses = path(16, step=0.02)
    config = QUICK.model_copy(update={"judge_hidden": False})
    made = run(snowed(poses, SNOWED).frames(SMALL), config, snowed(poses, SNOWED)).store.keyframes
    assert {k.frame_index for k in made} & set(SNOWED)


def test_of_a_hidden_picture_the_map_gets_what_agrees_and_of_a_clear_one_everything() -> None:
    poses = path(16, step=0.02)
    prior = snowed(poses, SNOWED)
    result = run(prior.frames(SMALL), QUICK, prior).by_index()
    for index, tracked in result.items():
        mask = tracked.frame.mask
        assert (mask is not None) is (index in SNOWED)
        assert mask is None or 0.2 < mask.mean() < 0.6


def test_a_keyframe_that_goes_out_of_view_is_replaced_even_by_a_frame_with_snow() -> None:
    """What the new one takes over is what agrees with its pose, and that is right."""
    poses = path(30, step=0.06)
    prior = snowed(poses, range(8, 20))
    result = run(prior.frames(SMALL), QUICK, prior)
    assert {t.frame_class for t in result.tracked} <= PLACED
    snowy = [k for k in result.store.keyframes if k.frame_index >= 8]
    assert snowy
    scale = 1.0 / result.store[0].pointmap.rho[36, 48] / plane_depth(poses[0])[36, 48]
    for keyframe in snowy:
        known = keyframe.pointmap.is_known(0.15)
        truth = scale * plane_depth(poses[keyframe.frame_index])[known]
        assert known.any()
        assert np.median(np.abs(1.0 / keyframe.pointmap.rho[known] / truth - 1.0)) < 0.02
    assert error_share(result.tracked, poses) < 0.01


def test_a_contradicted_frame_takes_no_depth_over_matches_that_its_pose_does_not_explain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On tiles a third of the matches may lie tiles off, and nothing is hidden."""
    poses = path(30, step=0.06)
    prior = told(poses)
    plain = prior.decode

    def tiles_off(
        a: KnownView, b: KnownView, predicted: np.ndarray | None = None, alone: bool = False
    ) -> KnownPair:
        pair = plain(a, b, predicted, alone)
        rng = np.random.default_rng(len(prior.predictions))
        pair.matches_back[rng.random(pair.valid_back.shape) < 0.3] += (0.0, 24.0)
        return pair

    prior.decode = tiles_off  # type: ignore[method-assign]
    monkeypatch.setattr(WideSteps, "is_contradicted", lambda *_: True)
    result = run(prior.frames(SMALL), QUICK, prior)
    later = result.store.keyframes[1:]
    assert later
    scale = 1.0 / result.store[0].pointmap.rho[36, 48] / plane_depth(poses[0])[36, 48]
    for keyframe in later:
        known = keyframe.pointmap.is_known(0.15)
        truth = scale * plane_depth(poses[keyframe.frame_index])[known]
        assert known.mean() > 0.3
        assert np.mean(np.abs(1.0 / keyframe.pointmap.rho[known] / truth - 1.0) > 0.05) < 0.01


# --- keyframes taken up again ---------------------------------------------------------------------

THERE = path(12)
HOVER = [*THERE, *(THERE[::-1] + THERE) * 2]
"""Out, and twice back and out again."""


def test_hovering_over_one_place_adds_no_keyframes() -> None:
    prior, once = told(HOVER), told(THERE)
    result = run(prior.frames(SMALL), QUICK, prior)
    first = run(once.frames(SMALL), QUICK, once)
    assert len(result.store) == len(first.store) > 1
    assert {t.frame_class for t in result.tracked} <= PLACED
    assert error_share(result.tracked, HOVER) < 0.01
    used = [t.keyframe for t in result.tracked]
    assert used[len(THERE) :].count(0) > 2


def wander(count: int) -> list[Sim3]:
    """Over one place, never twice the same, turning by up to 40 degrees to either side."""
    i = np.arange(count)
    turns = [0.1 * np.sin(0.21 * i), 0.1 * np.sin(0.17 * i), 0.7 * np.sin(0.047 * i)]
    centres = [0.35 * np.sin(0.13 * i), 0.3 * np.sin(0.111 * i + 0.3), 0.1 * np.sin(0.07 * i)]
    pairs = zip(np.transpose(turns), np.transpose(centres), strict=True)
    return [pose(tuple(turn), tuple(centre)) for turn, centre in pairs]


def test_a_place_that_has_keyframes_enough_gets_no_more() -> None:
    made = {}
    for crowd, count in ((3, 250), (1000, 190)):
        poses = wander(count)
        prior = told(poses)
        config = QUICK.model_copy(update={"crowd": crowd})
        result = run(prior.frames(SMALL), config, prior)
        assert {t.frame_class for t in result.tracked} <= PLACED
        assert error_share(result.tracked, poses) < 0.005
        made[crowd] = [keyframe.frame_index for keyframe in result.store.keyframes]
    assert len(made[3]) < len(made[1000])
    # Two where the camera goes further out than it was before.
    assert len([index for index in made[3] if index > 190]) <= 2


def test_a_camera_that_moves_backwards_leaves_its_keyframes_though_all_are_in_view() -> None:
    poses = [pose((0.0, 0.0, 0.0), (0.0, 0.0, -0.06 * i)) for i in range(40)]
    made = {}
    for crowd in (1, 1000):
        prior = told(poses)
        result = run(prior.frames(SMALL), QUICK.model_copy(update={"crowd": crowd}), prior)
        made[crowd] = [keyframe.frame_index for keyframe in result.store.keyframes]
    assert made[1] == made[1000]
    assert len(made[1]) > 3


def test_a_crowded_place_is_not_searched_anew_at_every_frame() -> None:
    poses, looks = wander(80), {}
    for look_s in (0.0, 1.0):
        prior = told(poses)
        result = run(prior.frames(SMALL), QUICK.model_copy(update={"crowd_look_s": look_s}), prior)
        assert error_share(result.tracked, poses) < 0.005
        looks[look_s] = len(prior.predictions) - len(poses)
    assert looks[1.0] < 0.7 * looks[0.0]


def test_keyframes_of_slightly_other_scale_leave_the_frames_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The expected motion is the last one again. Where one pose starts with the scale of the graph
    and the next, solved from the matches alone, with none, it must not have the step between."""
    prior, store = told(HOVER), KeyframeStore()
    frames, solve = prior.frames(SMALL), KeyframeMatcher._solve
    tracker = Tracker(prior, store, QUICK)
    for frame in frames[:12]:
        tracker.track(frame)
    for keyframe in store.keyframes[::2]:
        T = keyframe.T_wc
        keyframe.T_wc = Sim3(T.R, T.t, 1.01 * T.scale)
    later = []
    for frame in frames[12:]:
        from_scratch = frame.index % 4 == 0

        def start(
            matcher: KeyframeMatcher, problem: PoseProblem, at: Sim3, none: bool = from_scratch
        ) -> PoseEstimate | None:
            return solve(matcher, problem, Sim3(at.R, at.t / at.scale) if none else at)

        monkeypatch.setattr(KeyframeMatcher, "_solve", start)
        later += tracker.track(frame).frames
    scales = [t.T_wc.scale for t in later if t.T_wc is not None]
    of_keyframes = [keyframe.T_wc.scale for keyframe in store.keyframes]
    assert len({t.keyframe for t in later}) > 1
    assert len(scales) == len(later)
    assert min(of_keyframes) <= min(scales) <= max(scales) <= max(of_keyframes) < 1.02


def test_a_keyframe_that_is_in_another_place_than_thought_is_not_taken_up_again() -> None:
    """A new one is made: the loop between the two is for the graph to close."""
    prior = told(HOVER[:24])
    frames = prior.frames(SMALL)
    store = KeyframeStore()
    tracker = Tracker(prior, store, QUICK)
    for frame in frames[:12]:
        tracker.track(frame)
    left = len(store)
    store[0].T_wc = pose((0.0, 0.0, 0.0), (0.25, 0.0, 0.0)) @ store[0].T_wc
    for frame in frames[12:]:
        tracker.track(frame)
    assert len(store) > left


def test_a_keyframe_that_cannot_be_read_back_costs_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    prior = told(HOVER[:24])
    frames = prior.frames(SMALL)
    store = KeyframeStore()
    tracker = Tracker(prior, store, QUICK)
    tracked = [t for frame in frames[:12] for t in tracker.track(frame).frames]
    left, content = len(store), store.content

    def unreadable(number: int) -> object:
        if number < left - 1:
            raise InputError("the disk is full of sand")
        return content(number)

    monkeypatch.setattr(store, "content", unreadable)
    tracked += [t for frame in frames[12:] for t in tracker.track(frame).frames]
    assert len(store) > left
    assert {t.frame_class for t in tracked} <= PLACED
