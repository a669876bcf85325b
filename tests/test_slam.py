"""Slam end to end on a small recording, and its order of work behind a tracker that is told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from aquaflow.config import Config
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.views import View
from aquaflow.slam import Slam
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.types import Frame
from tests.slam_scenes import OPEN_GATE, STEPS, ToldTracker, config, frame_of

DRY = {"medium": {"enabled": False}}
"""Fitting water takes longer than all the rest; tests/render does it."""


@dataclass
class Ran:
    slam: Slam
    frames: list[Frame]
    decided: list[Tracked]


def ran(frames: list[Frame], settings: Config) -> Ran:
    slam = Slam(settings)
    decided = [tracked for frame in frames for tracked in slam.process(frame)]
    return Ran(slam, frames, decided + slam.finish())


# --- a real clip ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clip(small_recording: Path) -> list[Frame]:
    recording, frames = open_recording(small_recording), []
    prepare = Preparation(config().source, recording.camera)
    for frame in recording.frames(1, 0, None):
        assert isinstance(frame, Frame)
        frames.append(prepare(frame))
    recording.close()
    return frames[:18]


@pytest.fixture(scope="module")
def mapped(clip: list[Frame]) -> Ran:
    return ran(clip, config(**DRY))


def test_every_frame_is_decided_exactly_once(mapped: Ran) -> None:
    decided = sorted(tracked.frame.index for tracked in mapped.decided)
    assert decided == [frame.index for frame in mapped.frames]


def test_a_clip_becomes_poses_and_gaussians(mapped: Ran) -> None:
    assert sum(tracked.T_wc is not None for tracked in mapped.decided) > 14
    assert len(mapped.slam.mappers[0].gaussians) > 100
    assert mapped.slam.mappers[0].undone == 0


def test_every_eighth_frame_is_held_out_and_never_mapped(mapped: Ran) -> None:
    mapper, held = mapped.slam.mappers[0], mapped.slam.held_out[0]
    assert [view.frame_index for view in held] == [8, 16]
    used = {view.frame_index for view in mapper.views}
    posed = {tracked.frame.index for tracked in mapped.decided if tracked.T_wc is not None}
    assert used == posed - {8, 16}
    assert 0 in used


def test_the_same_clip_gives_the_same_map_bit_for_bit(mapped: Ran, clip: list[Frame]) -> None:
    again = ran(clip, config(**DRY)).slam.mappers[0]
    for name, tensor in mapped.slam.mappers[0].gaussians.parameters.items():
        assert np.array_equal(tensor.numpy(), again.gaussians.parameters[name].numpy()), name


def test_without_mapping_there_is_the_same_trajectory_and_no_map(
    mapped: Ran, clip: list[Frame]
) -> None:
    plain = ran(clip, config(enabled=False))
    assert plain.slam.mappers == {}
    assert plain.slam.held_out == {}
    assert len(plain.decided) == len(mapped.decided)
    for a, b in zip(plain.decided, mapped.decided, strict=True):
        assert a.frame.index == b.frame.index
        assert a.frame_class == b.frame_class
        if a.T_wc is not None and b.T_wc is not None:
            np.testing.assert_array_equal(a.T_wc.matrix, b.T_wc.matrix)


def test_a_repeated_picture_has_the_pose_of_the_first_also_before_there_is_a_map(
    clip: list[Frame],
) -> None:
    twice = [
        replace(frame, index=2 * i + repeat, t_ns=frame.t_ns + repeat)
        for i, frame in enumerate(clip[:12])
        for repeat in (0, 1)
    ]
    slam = ran(twice, config(enabled=False)).slam
    results = {each.frame.index: each for each in slam.results()}
    assert sorted(results) == list(range(24))
    for i in range(0, 24, 2):
        first, repeated = results[i].T_wc, results[i + 1].T_wc
        assert results[i + 1].frame_class is FrameClass.SKIPPED
        assert first is not None
        assert repeated is not None
        np.testing.assert_array_equal(first.matrix, repeated.matrix)


# --- the order of work ----------------------------------------------------------------------------


Calls = list[tuple[str, int]]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """What the mappers were asked to do: ("insert", frame) and ("optimise", steps)."""
    made: Calls = []

    def insert(self: Mapper, view: View, pointmap: Pointmap, base: object) -> int:
        made.append(("insert", view.frame_index))
        return 0

    def optimise(self: Mapper, steps: int) -> None:
        made.append(("optimise", steps))

    monkeypatch.setattr(Mapper, "insert", insert)
    monkeypatch.setattr(Mapper, "optimise", optimise)
    return made


Told = Callable[..., Slam]


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    def run(
        classes: str, sub_maps: str = "", indices: list[int] | None = None, **keys: object
    ) -> Slam:
        slam = Slam(config(OPEN_GATE, **keys))  # the frames are noise
        monkeypatch.setattr(slam, "tracker", ToldTracker(slam, classes, sub_maps))
        for index in indices or range(len(classes)):
            slam.process(frame_of(index))
        slam.finish()
        return slam

    return run


def test_classes_decide_insertion_and_the_number_of_steps(told: Told, calls: Calls) -> None:
    told("KCMC")
    assert calls == [
        ("insert", 0), ("optimise", 3),
        ("optimise", 1),
        ("insert", 2), ("optimise", 2),
        ("optimise", 1),
        ("insert", 0),  # the last keyframe, from its fused pointmap
    ]  # fmt: skip


def test_a_keyframe_is_inserted_again_when_the_next_one_retires_it(
    told: Told, calls: Calls
) -> None:
    told("KCKC")
    inserted = [number for what, number in calls if what == "insert"]
    assert inserted == [0, 0, 2, 2]


def test_frames_without_a_pose_reach_no_map(told: Told, calls: Calls) -> None:
    slam = told("KLLC")
    assert [view.frame_index for view in slam.mappers[0].views] == [0, 3]


def test_a_lost_frame_counts_in_the_holding_out(told: Told, calls: Calls) -> None:
    slam = told("KLLCCCCCC" + "C" * 8)
    assert [view.frame_index for view in slam.held_out[0]] == [8, 16]


def test_holding_out_counts_the_frames_that_were_used_and_not_their_indices(
    told: Told, calls: Calls
) -> None:
    slam = told("K" + "C" * 20, indices=list(range(0, 20, 2)), hold_out_every=3)
    assert [view.frame_index for view in slam.held_out[0]] == [6, 12, 18]


def test_no_frame_is_held_out_when_none_is_asked_for(told: Told, calls: Calls) -> None:
    slam = told("K" + "C" * 9, hold_out_every=0)
    assert slam.held_out == {}
    assert len(slam.mappers[0].views) == 10


def test_a_keyframe_that_is_held_out_gives_the_map_nothing(told: Told, calls: Calls) -> None:
    slam = told("KCCCCCCCKC")
    assert [view.frame_index for view in slam.held_out[0]] == [8]
    assert [number for what, number in calls if what == "insert"] == [0, 0]


def test_every_sub_map_has_a_map_of_its_own(told: Told, calls: Calls) -> None:
    slam = told("KCKC", sub_maps="0011")
    assert [view.frame_index for view in slam.mappers[0].views] == [0, 1]
    assert [view.frame_index for view in slam.mappers[1].views] == [2, 3]
    assert [number for what, number in calls if what == "insert"] == [0, 0, 2, 2]


def test_only_common_frames_are_robust_and_poses_are_the_views_own(
    told: Told, calls: Calls
) -> None:
    views = told("KCM").mappers[0].views
    assert [view.robust for view in views] == [False, True, False]
    assert [float(view.T_wc.t[0]) for view in views] == [0.0, 0.01, 0.02]


def test_the_stages_are_timed(told: Told, calls: Calls) -> None:
    stages = told("KCM").profiler.summary()
    assert {"track", "insert", "optimise", "refine"} <= set(stages)


def test_progress_of_the_refinement_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    slam, steps = Slam(config(OPEN_GATE)), []
    monkeypatch.setattr(slam, "tracker", ToldTracker(slam, "KMM"))
    for index in range(3):
        slam.process(frame_of(index))
    slam.finish(lambda done, total: steps.append((done, total)))
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_too_few_views_are_not_worth_a_refinement(told: Told) -> None:
    slam = told("KM")
    assert len(slam.mappers[0].gaussians) > 0
    assert slam.mappers[0].steps == STEPS["steps_keyframe"] + STEPS["steps_mapping"]


def test_a_corrected_keyframe_takes_its_frames_and_their_sub_map_along(
    told: Told, calls: Calls
) -> None:
    slam = told("KCMKC", "00011")
    before = slam.results()
    S = Sim3(np.eye(3), np.array([5.0, 0.0, 0.0]), 2.0)
    first, second = slam.keyframes[0], slam.keyframes[1]
    second.T_wc, second.sub_map = S @ second.T_wc, first.sub_map
    after = slam.results()
    for old, new in zip(before, after, strict=True):
        moved = old.frame.index >= 3
        assert old.T_wc is not None
        assert new.T_wc is not None
        assert np.allclose(new.T_wc.t, S.apply(old.T_wc.t) if moved else old.T_wc.t)
        assert (old.sub_map, new.sub_map) == (int(moved), 0)


def test_a_frame_without_a_pose_settles_as_it_is(told: Told, calls: Calls) -> None:
    *posed, lost = told("KCL").results()
    assert all(tracked.T_wc is not None for tracked in posed)
    assert (lost.frame.index, lost.frame_class) == (2, FrameClass.LOST)
    assert (lost.keyframe, lost.T_wc) == (None, None)
