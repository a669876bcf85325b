"""Which flow of a pair is taken, and how many are tried."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aquaflow.prior.candidates import GOOD_SHARE, LEAST_IN_VIEW, best_flow, share_in_view

HEIGHT, WIDTH = 96, 160
ENCODING: Any = SimpleNamespace(grey=None, texture=None)


def moved(x_px: float) -> Any:
    """[H, W, 2] px: everything moves to the right."""
    return np.broadcast_to(np.array([x_px, 0.0], np.float32), (HEIGHT, WIDTH, 2))


class Matcher:
    """Stands in for the flow: matches the given shares, one after the other."""

    def __init__(self, *shares: float) -> None:
        self.shares, self.calls = list(shares), 0

    def __call__(self, *_: object, **__: object) -> Any:
        self.calls += 1
        return SimpleNamespace(share=self.shares.pop(0))


@pytest.mark.parametrize(("x_px", "share"), [(0.0, 1.0), (40.0, 0.75), (-80.0, 0.5), (170.0, 0.0)])
def test_what_moves_out_of_the_picture_is_not_in_view(x_px: float, share: float) -> None:
    assert share_in_view(moved(x_px)) == pytest.approx(share, abs=0.05)


def test_half_of_what_stays_in_view_is_enough() -> None:
    matcher: Any = Matcher(0.4)
    assert best_flow(matcher, ENCODING, ENCODING, [None], moved(40.0)).share == 0.4
    assert matcher.calls == 1


def test_less_than_half_of_what_stays_in_view_gets_rivals() -> None:
    matcher: Any = Matcher(0.3, 0.2, 0.45)
    flow = best_flow(matcher, ENCODING, ENCODING, [None, moved(1.0), moved(2.0)], moved(40.0))
    assert flow.share == 0.45


def test_a_prediction_that_leaves_nothing_in_view_is_not_believed_without_matches() -> None:
    too_few, enough = 0.9 * GOOD_SHARE * LEAST_IN_VIEW, 1.1 * GOOD_SHARE * LEAST_IN_VIEW
    matcher: Any = Matcher(too_few, enough)
    assert best_flow(matcher, ENCODING, ENCODING, [None], moved(170.0)).share == enough


def test_without_a_prediction_half_of_the_picture_must_be_matched() -> None:
    matcher: Any = Matcher(0.45, 0.48, 0.6)
    assert best_flow(matcher, ENCODING, ENCODING, [None, None, None, None]).share == 0.6
    assert matcher.calls == 3
