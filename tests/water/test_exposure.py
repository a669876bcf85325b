"""How much brighter each view is than the others."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aquaflow.render.views import View
from aquaflow.water.exposure import (
    FEWEST,
    MAX_LOG_GAIN,
    TOWARDS_ONE,
    gain_of,
    learn_gain,
    log_gain_at,
    set_log_gains,
)
from tests.mapping.mapping_scenes import view_of

SOLID = torch.ones(48, 64)
GAIN = np.array([0.6, 0.8, 1.2])


def drawn() -> torch.Tensor:
    return 0.2 + 0.4 * torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))


def filmed_brighter(gain: np.ndarray = GAIN) -> View:
    return view_of((255.0 * drawn().numpy() * gain).round().clip(0, 255).astype(np.uint8))


def along(*log_gains: float) -> list[View]:
    views = [view_of(np.zeros((2, 2, 3), np.uint8), index=10 * i) for i in range(len(log_gains))]
    for view, log_gain in zip(views, log_gains, strict=True):
        view.log_gain = torch.full((3,), log_gain, dtype=torch.float64)
    return views


def test_the_gain_is_that_between_drawing_and_picture() -> None:
    view = filmed_brighter()
    learn_gain(view, drawn(), SOLID)
    np.testing.assert_allclose(gain_of(view), GAIN, rtol=0.01)


def test_a_quarter_of_the_picture_that_is_something_else_changes_nothing() -> None:
    view = filmed_brighter()
    fish = drawn()
    fish[:24, :32] = 0.9
    learn_gain(view, fish, SOLID)
    np.testing.assert_allclose(gain_of(view), GAIN, rtol=0.1)


def test_the_gain_leans_towards_one() -> None:
    view = filmed_brighter()
    learn_gain(view, drawn(), SOLID)
    np.testing.assert_allclose(view.log_gain, (1.0 - TOWARDS_ONE) * np.log(GAIN), atol=2e-3)


@pytest.mark.parametrize("what", ["bare", "vehicle", "black", "clipped", "not finite"])
def test_a_picture_that_says_nothing_leaves_the_gain_as_it_was(what: str) -> None:
    view = filmed_brighter()
    view.log_gain = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    picture, alpha = drawn(), SOLID.clone()
    if what == "bare":
        alpha[:] = 0.5
    elif what == "vehicle":
        view.mask = np.zeros((48, 64), bool)
    else:
        picture[:] = {"black": 0.0, "clipped": 1.0, "not finite": torch.nan}[what]
    learn_gain(view, picture, alpha)
    assert view.log_gain.tolist() == [0.1, 0.2, 0.3]


def test_fewer_pixels_than_needed_are_not_believed() -> None:
    view, alpha = filmed_brighter(), torch.zeros(48, 64)
    alpha.view(-1)[: FEWEST - 1] = 1.0
    learn_gain(view, drawn(), alpha)
    assert not view.log_gain.any()
    alpha.view(-1)[: FEWEST + 1] = 1.0
    learn_gain(view, drawn(), alpha)
    assert view.log_gain.all()


def test_the_gain_is_bounded() -> None:
    view = view_of(np.full((48, 64, 3), 240, np.uint8))
    learn_gain(view, torch.full((48, 64, 3), 0.021), SOLID)
    assert view.log_gain.tolist() == [MAX_LOG_GAIN] * 3


def test_a_view_that_was_never_mapped_lies_between_its_neighbours() -> None:
    views = along(0.0, 0.4)
    np.testing.assert_allclose(log_gain_at(5, views), 0.2)
    np.testing.assert_allclose(log_gain_at(-3, views), 0.0)
    np.testing.assert_allclose(log_gain_at(99, views), 0.4)


def test_views_between_fitted_ones_take_the_change_between_them() -> None:
    views = along(0.0, 0.5, 0.0)
    set_log_gains(views, [views[0], views[2]], np.array([[0.2] * 3, [0.4] * 3]))
    np.testing.assert_allclose([view.log_gain[0] for view in views], [0.2, 0.8, 0.4])


def test_a_last_view_in_which_nothing_was_sighted_changes_as_the_one_before() -> None:
    views = along(0.0, 0.0, 0.0)
    set_log_gains(views, views, np.array([[0.2] * 3, [0.4] * 3]))
    np.testing.assert_allclose([view.log_gain[0] for view in views], [0.2, 0.4, 0.4])
