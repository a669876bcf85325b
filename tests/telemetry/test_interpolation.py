"""Measurements between their samples."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.telemetry.camera_path import LONGEST_INTERPOLATED_S, Interpolation
from aquaflow.telemetry.telemetry import Series

S = 1_000_000_000


def measured(*pairs: tuple[float, float], source: str = "bar30") -> Series:
    t_s, values = np.array(pairs).reshape(-1, 2).T
    return Series(source, t_s, values[:, None])


def test_between_two_samples_the_value_is_linear() -> None:
    depth = Interpolation.of([measured((1, 2.0), (2, 4.0), (3, 8.0))])
    assert [depth.at(t * S) for t in (1, 2, 3)] == [2.0, 4.0, 8.0]
    assert depth.at(S + S // 4) == pytest.approx(2.5)
    assert depth.at(2 * S + S // 2) == pytest.approx(6.0)


def test_nothing_is_said_outside_of_the_samples_and_in_gaps() -> None:
    depth = Interpolation.of([measured((0, 1.0), (LONGEST_INTERPOLATED_S + 0.1, 2.0))])
    assert [depth.at(t) for t in (-1, S, 3 * S)] == [None, None, None]
    assert depth.at(0) == 1.0
    assert Interpolation.of([]).at(0) is None


def test_the_source_with_most_samples_counts_and_no_value_that_is_not_finite() -> None:
    many = measured((0, 1.0), (1, float("nan")), (2, 3.0), source="many")
    few = measured((0, 9.0), (2, 9.0), source="few")
    assert Interpolation.of([few, many]).at(S) == pytest.approx(2.0)
