"""Is there water? Found where it is and not where it is not, on dives drawn at random."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.water.beliefs import RegionalColours
from aquaflow.water.observations import FEWEST, lightness_over_range, regions_of
from tests.water.decision_table import kinds, row
from tests.water.simulated_dives import Kind, dive
from tests.water.water_observations import fitted, sighted


@pytest.mark.parametrize("span", [1.5, pytest.param(3.0, marks=pytest.mark.slow)])
def test_water_is_found_and_clear_water_is_called_clear(span: float) -> None:
    for water in (True, False):
        found = row(Kind(span, 0.02, 0.2, water), dives=2)
        assert found.right == found.dives


def test_water_that_takes_next_to_nothing_is_clear_however_sure() -> None:
    kind = Kind(3.0, 0.005, 0.2, water=False)
    assert not fitted(dive(kind, seed=7).seen).model.water


def test_where_no_range_span_tells_the_usual_water_is_taken_and_said_to_be_unsure() -> None:
    estimate = fitted(dive(Kind(1.0, 0.005, 0.0), seed=0).seen)
    assert estimate.model.water
    assert estimate.beta_a_sigma is not None
    assert max(estimate.beta_a_sigma) > 0.2


def test_without_water_points_look_the_same_from_all_ranges() -> None:
    estimate = fitted(sighted(points=600))
    seen, restored = estimate.range_variance
    assert restored < 0.1 * seen
    assert estimate.lightness_over_range is not None
    seen, restored = estimate.lightness_over_range
    assert abs(restored - 1.0) < 0.02 < abs(seen - 1.0)


def test_how_light_ground_is_from_far_is_not_told_where_none_was_seen_from_near_and_far() -> None:
    seen = sighted(points=200)
    assert lightness_over_range(seen, seen.colour) is not None
    level = replace(seen, z=np.full_like(seen.z, 1.0))
    assert lightness_over_range(level, seen.colour) is None


def test_regions_have_as_many_points_each_and_lie_side_by_side() -> None:
    positions = np.random.default_rng(0).uniform(-1.0, 1.0, (640, 3)) * (8.0, 1.0, 0.1)
    region = regions_of(positions)
    counts = np.bincount(region)
    assert len(counts) == 32
    assert counts.min() >= 640 // 32 - 1
    widths = [np.ptp(positions[region == number, 0]) for number in range(32)]
    assert max(widths) < 2.0


def test_few_points_make_few_regions_and_none_at_all_makes_none() -> None:
    assert regions_of(np.zeros((3, 3))).tolist() == [0, 0, 0]
    assert len(regions_of(np.zeros((0, 3)))) == 0
    assert np.bincount(regions_of(np.random.default_rng(1).normal(size=(40, 3)))).min() >= FEWEST


def test_regions_that_are_all_alike_are_as_expected_and_a_red_one_is_not() -> None:
    J = np.tile(np.linspace(0.1, 0.5, 80), (3, 8))
    region = np.repeat(np.arange(8), 80)
    alike = RegionalColours(region).residuals(J)
    np.testing.assert_allclose(alike, 0.0, atol=1e-12)
    J[0, :80] *= 2.0
    assert np.abs(RegionalColours(region).residuals(J)).max() > 1.0


@pytest.mark.slow
def test_the_whole_table_is_decided_rightly() -> None:
    """At spans from 1:1.5: water in 98 % of the dives, clear water in 95 %."""
    for water, share in ((True, 0.98), (False, 0.95)):
        rows = [row(kind, 9) for kind in kinds() if kind.water is water and kind.span >= 1.5]
        assert sum(r.right for r in rows) >= share * sum(r.dives for r in rows)


def test_the_estimate_of_a_clear_dive_has_no_water_in_it() -> None:
    estimate = fitted(dive(Kind(2.0, 0.005, 0.0, water=False), seed=0).seen)
    assert not estimate.beta_a.any()
    assert estimate.balance is None
