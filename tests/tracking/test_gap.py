"""After a time without pictures: another place is not taken for the one that was left."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import numpy as np
import pytest

from aquaflow.config import Config
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe
from aquaflow.lab.synthetic.survey import FPS, SurveyPictures
from aquaflow.lab.synthetic.survey_plan import plan_of
from aquaflow.slam import Slam
from aquaflow.tracking.current_keyframe import MOST_STRETCH, CurrentKeyframe
from aquaflow.types import Frame

BEFORE, GAP, AFTER = 40, 50, 8
"""Pictures, ten a second: a restart takes 5 s."""
CONFIG = Config.model_validate({"threads": 1, "mapping": {"enabled": False}})


@cache
def survey() -> SurveyPictures:
    return SurveyPictures(96, plan=plan_of("hour", 2000.0))


def taken_at(number: int, frame: Frame) -> Frame:
    """``frame`` as number so many, after the gap from BEFORE on."""
    t_ns = round((number + (GAP if number >= BEFORE else 0)) * 1e9 / FPS)
    return replace(frame, index=number, t_ns=t_ns, arrival_ns=t_ns)


def errors_after_a_gap(start: int, hovering: bool = False) -> list[float]:
    """m, of the poses that pictures after a gap get in the map that was begun before it."""
    first = start + BEFORE + (0 if hovering else GAP)
    taken = [*range(start, start + BEFORE), *range(first, first + AFTER)]
    slam = Slam(CONFIG)
    results = [
        result
        for number, index in enumerate(taken)
        for result in slam.process(taken_at(number, survey().frame(index)))
        if result.T_wc is not None
    ]
    sub_map = next(each.sub_map for each in results if each.frame.index == BEFORE - 1)
    own = [each for each in results if each.sub_map == sub_map]
    truth = np.array([survey().T_wc(taken[each.frame.index]).t for each in own])
    found = np.array([each.T_wc.t for each in own])
    before = np.array([each.frame.index < BEFORE for each in own])
    T = align(found[before], truth[before], with_scale=True).T_target_source
    return np.linalg.norm(T.apply(found[~before]) - truth[~before], axis=1).tolist()


@pytest.mark.parametrize("start", [477, 1939, 2493, 2770])
def test_pictures_of_another_place_after_a_gap_are_not_placed_where_the_last_was(
    start: int,
) -> None:
    assert max(errors_after_a_gap(start), default=0.0) < 0.2


def test_a_place_that_is_seen_again_after_a_gap_is_known() -> None:
    errors = errors_after_a_gap(477, hovering=True)
    assert len(errors) == AFTER
    assert max(errors) < 0.1


def test_a_gap_lasts_until_a_frame_is_placed_or_telemetry_says_how_far_it_went() -> None:
    at = CurrentKeyframe(Mock(spec=Keyframe))
    at.interval_ns, at.t_ns = 100, 1000
    at.expect(1000 + int(MOST_STRETCH * 100), None)
    assert not at.after_gap
    at.interval_ns = 100
    at.expect(1001 + int(MOST_STRETCH * 100), None)
    assert at.after_gap
    at.t_ns += 500
    at.expect(at.t_ns + 100, None)  # the first frame after the gap was lost
    assert at.after_gap
    at.expect(at.t_ns + 100, Sim3.identity())
    assert not at.after_gap
