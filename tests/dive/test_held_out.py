"""Held-out frames: which there are, and what is reported of their restoration."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import Config
from aquaflow.dive.held_out import examine_held_out
from aquaflow.dive.held_out_example import HeldOut, Perceived, mean_amplification
from aquaflow.slam import Slam

PICTURE = np.zeros((48, 64, 3), np.uint8)


def held_out(amplification: list[list[float]] | None) -> HeldOut:
    known = None if amplification is None else np.array(amplification, np.float32)
    return HeldOut(
        8, PICTURE, PICTURE, None, 20.0, 0.5, Perceived(None, None, None), amplification=known
    )


def test_a_dive_without_a_map_has_nothing_to_examine() -> None:
    assert examine_held_out(Slam(Config.model_validate({})), 0, {}) == []


def test_the_amplification_is_the_mean_over_the_views_that_have_one() -> None:
    views = [[[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]], None, [[3.0, 1.0, 1.0], [4.0, 2.0, 2.0]]]
    found = mean_amplification([held_out(each) for each in views])
    assert found is not None
    applied, allowed = found
    assert applied == pytest.approx([2.0, 1.0, 1.0])
    assert allowed == pytest.approx([3.0, 2.0, 2.0])


def test_without_a_posterior_there_is_no_amplification_to_report() -> None:
    assert mean_amplification([held_out(None)]) is None
    assert mean_amplification([]) is None
