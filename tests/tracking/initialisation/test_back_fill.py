"""A live run goes on by a few frames up to the newest, and looks back when there is time."""

from __future__ import annotations

import itertools
from threading import Event

import pytest

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.worker import Worker
from aquaflow.config import InitialisationConfig, TrackingConfig
from aquaflow.config.presets import load_configured
from aquaflow.keyframes import KeyframeStore
from aquaflow.lab.synthetic.survey import SurveyPictures
from aquaflow.lab.synthetic.survey_plan import SurveyPlan, plan_of
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.tracking.frames import BOUNDS, Bound, Step, Tracked, Wait
from aquaflow.tracking.map_start import MOST_FOLLOWED
from aquaflow.tracking.tracker import Tracker
from aquaflow.types import Frame
from tests.tracking.tracked_clips import Prompt, error_share, run
from tests.tracking.tracking_scenes import SeaFloor, black, filmed, lawn_path

POSES = lawn_path(12, step_m=0.12)


SLOW_POSES = lawn_path(19, step_m=0.03)


def thinning(**settings: float) -> TrackingConfig:
    """Of a slow clip, initialisation leaves most frames out."""
    return TrackingConfig(initialisation=InitialisationConfig.model_validate(settings))


@pytest.fixture(scope="module")
def clip() -> list[Frame]:
    return filmed(SeaFloor(), POSES)


def live(config: TrackingConfig | None = None, worker: Worker | None = None) -> Tracker:
    settings = config or TrackingConfig()
    return Tracker(ClassicalPrior(), KeyframeStore(), settings, worker=worker or Prompt())


def until_started(tracker: Tracker, clip: list[Frame]) -> tuple[list[Tracked], int]:
    """What the frame that starts the map decides, and that frame's index."""
    for frame in clip:
        decided = tracker.track(frame).frames
        if decided:
            return decided, frame.index
    pytest.fail("no map was started")


def left(decided: list[Tracked], newest: int) -> list[int]:
    """Frames that wait once a map has started, from the newest to the oldest."""
    return sorted(set(range(newest)) - {each.frame.index for each in decided}, reverse=True)


def test_the_start_decides_the_keyframe_and_a_few_frames_up_to_the_newest() -> None:
    tracker = live(thinning(max_waiting=6))
    decided, newest = until_started(tracker, filmed(SeaFloor(), SLOW_POSES))
    indices = [tracked.frame.index for tracked in decided]
    assert newest > 6
    assert indices == sorted(indices)
    assert (indices[0], indices[-1]) == (0, newest)
    assert 2 < len(indices) <= 1 + MOST_FOLLOWED
    assert tracker.past is not None
    assert tracker.past.index == left(decided, newest)[0]


@pytest.mark.parametrize("plan", [plan_of("hour", 2000.0), None])
def test_over_a_flat_seabed_a_live_start_is_near_the_truth(plan: SurveyPlan | None) -> None:
    survey = SurveyPictures(96, plan=plan)
    config = load_configured(None, "fast", {}, "test").tracking
    tracker, count = live(config), 40
    decided = [each for frame in survey.frames(count) for each in tracker.track(frame).frames]
    decided += tracker.finish().frames
    assert len(decided) == count
    # 26 % from the newest frame alone, whose pose the start had wrong; 0.3 % in a replay.
    assert error_share(decided, [survey.T_wc(i) for i in range(count)]) < 0.02


def test_the_past_is_placed_frame_by_frame_and_as_well(clip: list[Frame]) -> None:
    tracker = live()
    decided, newest = until_started(tracker, clip)
    for frame in clip[newest + 1 :]:
        decided += tracker.track(frame).frames
    while tracker.past is not None:
        placed = tracker.back_fill().frames
        assert len(placed) == 1
        decided += placed
    assert tracker.back_fill() == Step()
    assert sorted(tracked.frame.index for tracked in decided) == list(range(len(clip)))
    assert all(tracked.T_wc is not None for tracked in decided)
    assert error_share(decided, POSES) < 0.01


def test_a_replay_follows_what_initialisation_left_out_from_keyframe_to_keyframe() -> None:
    poses = lawn_path(15, step_m=0.09)
    until_the_end = thinning(max_waiting=3, parallax_widths=0.15)
    followed = run(filmed(SeaFloor(), poses), until_the_end)
    numbers = [tracked.keyframe for _, tracked in sorted(followed.by_index().items())]
    assert numbers == sorted(numbers)
    assert len(followed.store) > 2
    assert error_share(followed.tracked, poses) < 5e-4


def test_a_live_run_looks_back_from_the_newest_frame_to_the_oldest() -> None:
    tracker = live(thinning(max_waiting=6))
    decided, newest = until_started(tracker, filmed(SeaFloor(), SLOW_POSES))
    placed = []
    while tracker.past is not None:
        placed += tracker.back_fill().frames
    assert newest > 6
    assert [tracked.frame.index for tracked in placed] == left(decided, newest)
    assert error_share([*decided, *placed], SLOW_POSES) < 1e-3


def test_a_frame_of_the_past_is_looked_for_beside_tracking(clip: list[Frame]) -> None:
    worker, go_on = Worker(threads=True), Event()
    tracker = live(worker=worker)
    decided, newest = until_started(tracker, clip)
    worker.ask("hold", 0, lambda: go_on.wait(60.0))
    assert tracker.back_fill() == tracker.back_fill() == Step()
    assert tracker.past is not None
    go_on.set()
    _, looked_back = worker.take_finished(wait=True)
    tracker.looked_back(looked_back.found)
    (placed,) = tracker.back_fill().frames
    first, *others = left(decided, newest)
    assert placed.frame.index == first
    assert placed.T_wc is not None
    ended = tracker.finish().frames
    assert sorted(tracked.frame.index for tracked in ended) == sorted(others) != []
    worker.close()


def test_the_end_of_a_dive_leaves_nobody_waiting(clip: list[Frame]) -> None:
    tracker = live()
    decided, newest = until_started(tracker, clip)
    decided += tracker.finish().frames
    assert sorted(tracked.frame.index for tracked in decided) == list(range(newest + 1))
    assert tracker.past is None


def test_an_end_without_time_leaves_the_oldest_without_a_pose(clip: list[Frame]) -> None:
    tracker, looks = live(), itertools.count()
    decided, newest = until_started(tracker, clip)
    ended = tracker.finish(Deadline(1.5, lambda: float(next(looks)))).frames
    posed = [tracked.frame.index for tracked in ended if tracked.T_wc is not None]
    first, *others = left(decided, newest)
    assert posed == [first]
    assert others != []
    decided += ended
    assert sorted(tracked.frame.index for tracked in decided) == list(range(newest + 1))


def test_a_run_that_never_has_time_forgets_the_oldest_and_says_so(
    clip: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BOUNDS, Wait.IN_IDLE_TIME, Bound(1, "no time to look back"))
    decided, newest = until_started(live(), clip)
    forgotten = [tracked.frame.index for tracked in decided if tracked.T_wc is None]
    placed = [tracked for tracked in decided if tracked.T_wc is not None]
    assert forgotten == sorted(left(placed, newest)[1:]) != []
    assert {tracked.reason for tracked in decided if tracked.T_wc is None} == {
        "no time to look back"
    }


def test_a_frame_of_the_past_that_shows_nothing_is_lost(clip: list[Frame]) -> None:
    tracker = live()
    _, newest = until_started(tracker, clip)
    tracker._waiting.put([black(newest - 1)], Wait.IN_IDLE_TIME)
    (lost,) = tracker.back_fill().frames
    assert lost.T_wc is None
    assert lost.reason == "no pose found"


def test_a_run_that_is_never_lost_keeps_nothing_of_the_frames_it_placed(clip: list[Frame]) -> None:
    tracker = live()
    for frame in clip:
        tracker.track(frame)
        while tracker.past is not None:
            tracker.back_fill()
    assert len(tracker._back_fills._left) <= 1
