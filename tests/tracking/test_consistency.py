"""A wrong scale is noticed within 5 s and repaired; a sound dive raises no alarm."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from aquaflow.config import MonitorConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore
from aquaflow.tracking import current_keyframe
from aquaflow.tracking.consistency import Cause
from aquaflow.tracking.current_keyframe import CurrentKeyframe
from aquaflow.tracking.frames import Step, Tracked
from aquaflow.tracking.pose.depth_fusion import MOST_FUSED
from aquaflow.tracking.tracker import Tracker
from aquaflow.tracking.wide_steps import WideSteps
from tests.tracking.tracked_clips import PLACED, QUICK, SMALL, error_share, path, told

THERE = path(14)
HOVER = [*THERE, *(THERE[::-1] + THERE) * 4]
"""Out, and four times back and out again."""
PLANTED = 56
NOTICED = PLANTED + 50
"""5 s later, at 10 frames/s."""
FACTOR = 1.2

Fault = Callable[[CurrentKeyframe, int], None]


def nothing(at: CurrentKeyframe, index: int) -> None:
    pass


def depths(at: CurrentKeyframe, index: int) -> None:
    """The depths of the keyframe in use grow at one moment."""
    if index == PLANTED:
        at.keyframe.pointmap.rho /= FACTOR
        at.keyframe.pointmap.variance /= FACTOR**2


def scale(at: CurrentKeyframe, index: int) -> None:
    """The scale of its pose does."""
    if index == PLANTED:
        T = at.keyframe.T_wc
        at.keyframe.T_wc = Sim3(T.R, T.t, FACTOR * T.scale)


def bend(at: CurrentKeyframe, index: int) -> None:
    """Depths are wrong by turns, with no common scale, in a keyframe that has had its frames."""
    if index == PLANTED:
        which = np.arange(SMALL.height)[:, None] // 6 % 3
        at.keyframe.pointmap.rho *= 1.2 ** (which - 1.0)
        at.keyframe.pointmap.fused = MOST_FUSED


def drift(at: CurrentKeyframe, index: int) -> None:
    """Depths grow by 0.5 % a frame: much faster than a real drift, in a short clip."""
    if index >= PLANTED:
        at.keyframe.pointmap.rho /= 1.005
        at.keyframe.pointmap.variance /= 1.005**2


def steps(fault: Fault, enabled: bool = True) -> tuple[Tracker, list[Step]]:
    config = QUICK.model_copy(update={"monitor": MonitorConfig(enabled=enabled)})
    prior, store = told(HOVER), KeyframeStore()
    tracker, made = Tracker(prior, store, config), []
    for frame in prior.frames(SMALL):
        if tracker._at is not None:
            fault(tracker._at, frame.index)
        made.append(tracker.track(frame))
    return tracker, [*made, tracker.finish()]


@cache
def swum(fault: Fault, enabled: bool = True) -> tuple[Tracker, list[Step]]:
    """Of a tracker that no test has changed; only read."""
    return steps(fault, enabled)


def frames_of(made: list[Step]) -> list[Tracked]:
    return [tracked for step in made for tracked in step.frames]


def swim(fault: Fault, enabled: bool = True) -> tuple[Tracker, list[Tracked]]:
    tracker, made = swum(fault, enabled)
    return tracker, frames_of(made)


def late_error(tracked: list[Tracked]) -> float:
    """Of the frames from when the fault should have been noticed on, with those before it."""
    return error_share([t for t in tracked if not PLANTED <= t.frame.index < NOTICED], HOVER)


def test_a_sound_dive_raises_no_alarm() -> None:
    tracker, tracked = swim(nothing)
    counts = tracker.monitor.counts
    assert counts.checks >= len(HOVER) // (2 * MonitorConfig().every)
    assert counts.found == 0
    assert tracker.monitor.trouble is None
    assert counts.notes() == []
    assert {t.frame_class for t in tracked} <= PLACED


@pytest.mark.parametrize(("fault", "cause"), [(depths, Cause.DEPTHS), (scale, Cause.POSE)])
def test_a_wrong_scale_is_noticed_within_five_seconds_and_repaired(
    fault: Fault, cause: Cause
) -> None:
    tracker, tracked = swim(fault)
    counts = tracker.monitor.counts
    assert counts.found >= 1
    first = counts.findings[0]
    assert PLANTED <= first.frame < NOTICED
    assert first.cause is cause
    assert first.ratio == pytest.approx(FACTOR, abs=0.03)
    assert counts.rescaled + counts.relocalised == counts.found
    assert "scale" in counts.notes()[0]
    assert late_error(tracked) < 0.0005


def test_depths_that_no_scale_corrects_are_triangulated_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the keyframe is not left before, as the test below says that it is."""
    monkeypatch.setattr(current_keyframe, "SCARCE", 0.0)
    monkeypatch.setattr(WideSteps, "is_contradicted", lambda *_: False)
    tracker, made = steps(bend)
    tracked = frames_of(made)
    counts = tracker.monitor.counts
    assert [finding.cause for finding in counts.findings][:1] == [Cause.MATCHES]
    assert counts.findings[0].frame < NOTICED
    assert counts.refused == counts.relocalised == counts.found
    # Where that did not help, the keyframe is used no more.
    assert len(counts.findings) <= 2
    assert late_error(tracked) < 0.008
    last = counts.findings[-1].frame
    assert error_share([t for t in tracked if not PLANTED <= t.frame.index <= last], HOVER) < 0.0005


def test_a_keyframe_whose_depths_no_scale_corrects_is_left_before_it_does_harm() -> None:
    tracker, tracked = swim(bend)
    assert tracker.monitor.counts.found == 0
    assert {t.frame_class for t in tracked} <= PLACED
    assert late_error(tracked) < 0.0005


def test_without_the_monitor_the_fault_stays() -> None:
    """So the test above tests it."""
    tracker, tracked = swim(depths, enabled=False)
    assert tracker.monitor.counts.checks == 0
    assert late_error(tracked) > 3.0 * late_error(swim(depths)[1])


def test_depths_that_grow_slowly_are_brought_back_again_and_again() -> None:
    tracker, tracked = swim(drift)
    assert tracker.monitor.counts.rescaled >= 2
    assert late_error(tracked) < 0.02


def test_a_finding_is_shown_for_some_seconds() -> None:
    tracker, _ = swim(depths)
    last = tracker.monitor.counts.findings[-1]
    assert (tracker.monitor.trouble == last) is (len(HOVER) - last.frame <= 50)


def test_a_keyframe_whose_scale_is_wrong_is_returned_to_no_more() -> None:
    tracker, made = swum(scale)
    tracked = frames_of(made)
    revisits = [revisit for step in made for revisit in step.revisits]
    found = tracker.monitor.counts.findings[0]
    assert found.keyframe not in {t.keyframe for t in tracked if t.frame.index > found.frame}
    assert [revisit.keyframe for revisit in revisits] == [found.keyframe]
