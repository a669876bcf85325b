"""Measurements between their samples."""

from __future__ import annotations

import numpy as np

from aquaflow.fusion.series import LONGEST_GAP_NS, Series

S = 1_000_000_000


def test_between_two_samples_the_value_is_linear_whatever_their_order() -> None:
    series = Series.of([(3 * S, 8.0), (S, 2.0), (2 * S, 4.0)])
    assert [series.at(t) for t in (S, 2 * S, 3 * S)] == [2.0, 4.0, 8.0]
    assert series.at(S + S // 4) == 2.5
    assert series.at(2 * S + S // 2) == 6.0


def test_nothing_is_said_outside_of_the_samples_and_in_gaps() -> None:
    series = Series.of([(0, 1.0), (LONGEST_GAP_NS + 1, 2.0)])
    assert series.at(-1) is None
    assert series.at(LONGEST_GAP_NS + 2) is None
    assert series.at(S) is None
    assert series.at(0) == 1.0
    assert Series.of([]).at(0) is None


def test_the_last_of_several_at_one_moment_counts_and_no_value_that_is_not_finite() -> None:
    series = Series.of([(0, 1.0), (0, 3.0), (S, float("nan")), (S, float("inf"))])
    assert series.values.tolist() == [3.0]


def test_times_of_years_keep_their_nanoseconds() -> None:
    late = 400 * 24 * 3600 * S
    series = Series.of([(late, 0.0), (late + 1000, 1.0)])
    assert np.isclose(series.at(late + 1), 1e-3, rtol=1e-9)
