"""The scale that several known lengths give together."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.telemetry.known_lengths.known_length import KnownLength, scale_of


def length(map_length: float, map_sigma: float = 0.01, frame: int = 0) -> KnownLength:
    return KnownLength(frame, "bar", map_length, map_sigma, 2.0, 0.002)


def test_a_length_gives_metres_per_unit_with_both_sigmas() -> None:
    known = length(1.0, 0.03)
    assert known.metres_per_unit == 2.0
    assert known.relative_sigma == pytest.approx(np.hypot(0.03, 0.001))


def test_no_length_gives_no_scale() -> None:
    assert scale_of([]) is None


def test_agreeing_lengths_are_averaged_by_their_certainty() -> None:
    scale = scale_of([length(1.0, 0.01), length(1.02, 0.1)])
    assert scale is not None
    assert scale.metres_per_unit == pytest.approx(2.0, rel=1e-3)
    assert scale.relative_sigma < length(1.0, 0.01).relative_sigma


def test_two_that_contradict_each_other_leave_it_as_uncertain_as_they_are_apart() -> None:
    scale = scale_of([length(1.0), length(1.3)])
    assert scale is not None
    assert scale.relative_sigma > 0.1
    assert scale.rejected == ()


def test_one_of_several_that_contradicts_the_others_is_rejected() -> None:
    wrong = length(1.3, frame=9)
    scale = scale_of([length(1.0), length(1.01), wrong, length(0.99)])
    assert scale is not None
    assert (scale.used, scale.rejected) == (3, (wrong,))
    assert scale.metres_per_unit == pytest.approx(2.0, rel=0.01)
