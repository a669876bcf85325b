"""The range that a water allows: from its attenuation, by the law of contrast."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.survey.coverage.classes import near_bins
from aquaflow.survey.coverage.footprint import mapping_range, visibility
from aquaflow.survey.coverage.raster import RANGE_BINS, GridFrame


def test_at_the_range_the_textures_contrast_is_the_least_one() -> None:
    attenuation = [0.9, 0.3, 0.4]
    found = mapping_range(attenuation, 0.1)
    assert found is not None
    assert 0.6 * np.exp(-0.3 * found) == pytest.approx(0.1)


def test_visibility_is_where_contrasts_fall_to_five_percent() -> None:
    assert visibility([2.0, 0.5, 1.0]) == pytest.approx(2.996 / 0.5, rel=1e-3)


@pytest.mark.parametrize("attenuation", [[], [0.0, 0.1, 0.2], [np.nan, 0.1, 0.2], [-1.0, 1.0, 1.0]])
def test_water_that_is_not_known_limits_nothing(attenuation: list[float]) -> None:
    assert mapping_range(attenuation, 0.1) is None
    assert near_bins(GridFrame(np.eye(3), 1.0, 1.0), None) == RANGE_BINS


def test_more_bins_are_near_the_further_the_water_lets_see() -> None:
    frame = GridFrame(np.eye(3), 0.1, 2.0)
    counts = [near_bins(frame, limit) for limit in (0.1, 1.0, 2.0, 3.0)]
    assert counts == sorted(set(counts))
    assert counts[0] == 0
