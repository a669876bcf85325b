"""Hints begin and end at values that differ, and speed is that of the newest seconds."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from aquaflow.config.service import CoverageConfig
from aquaflow.survey.coverage.live_coverage import (
    LEAST_STEPS,
    CoverageFigures,
    Hint,
    Hints,
    TrackedPlace,
    forward_steps,
)

CONFIG = CoverageConfig(overlap=0.6, forward_overlap=0.6)


@pytest.mark.parametrize(
    ("name", "hint", "values", "holds"),
    [
        ("forward_overlap", Hint.TOO_FAST, [0.8, 0.61, 0.59, 0.63, 0.66, 0.61], "--xx--"),
        ("range_share", Hint.TOO_HIGH, [0.5, 0.99, 1.01, 0.95, 0.89, 0.95], "--xx--"),
        ("line_overlap", Hint.TOO_FAR_ASIDE, [0.6, 0.47, 0.44, -0.5, 0.5, 0.53], "--xxx-"),
    ],
)
def test_a_hint_holds_until_the_value_is_clearly_better(
    name: str, hint: Hint, values: list[float], holds: str
) -> None:
    hints = Hints(CONFIG)
    found = [hint in hints.judge(CoverageFigures(**{name: value})) for value in values]
    assert found == [letter == "x" for letter in holds]


def test_of_what_is_not_known_nothing_is_said() -> None:
    hints = Hints(CONFIG)
    assert hints.judge(CoverageFigures(0.1, 2.0, 0.0)) == tuple(Hint)
    assert hints.judge(CoverageFigures()) == ()


def places(count: int, step: float, sub_map: int = 0, every_s: float = 0.5) -> deque[TrackedPlace]:
    return deque(
        TrackedPlace(every_s * i, sub_map, np.array([step * i, 0.0, 0.0])) for i in range(count)
    )  # fmt: skip


def test_the_speed_is_that_of_the_newest_seconds() -> None:
    path = places(30, 0.1)
    path.append(TrackedPlace(15.0, 0, np.array([8.0, 0.0, 0.0])))
    ways = forward_steps(path)
    assert len(ways) == 10
    assert np.median(np.linalg.norm(ways, axis=1)) == pytest.approx(0.1)


def test_of_a_few_pictures_or_of_another_sub_map_there_is_no_speed() -> None:
    assert len(forward_steps(deque())) == 0
    assert len(forward_steps(places(LEAST_STEPS, 0.1))) == 0
    path = places(20, 0.1)
    path.append(TrackedPlace(10.0, 1, np.zeros(3)))
    assert len(forward_steps(path)) == 0
