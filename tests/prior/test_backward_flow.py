"""The flow back: it is the inverse of the flow, and confirms no match that is wrong."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from aquaflow.prior.flow import Float, backward_flow, pixel_grid, reverse, sample
from tests.prior.textured_pictures import (
    HEIGHT,
    WIDTH,
    Array,
    grey_pair,
    inside,
    pixel_centres,
    shift,
    true_flow,
)

ZOOM = np.array([[1.05, -0.06, 5.0], [0.05, 1.02, -4.0], [0.0, 0.0, 1.0]])


def way_back_error(forward: Float, backward: Float) -> Float:
    """[H, W] px between a pixel of b and where it is after the ways back and forward."""
    target = pixel_grid(HEIGHT, WIDTH) + backward
    there = np.linalg.norm(backward + sample(forward, target), axis=-1)
    return np.asarray(there[inside(target, 8.0)], dtype=np.float32)


@pytest.mark.parametrize(
    "H", [shift(0.0, 0.0), shift(6.3, -3.6), ZOOM], ids=["none", "shift", "zoom"]
)
def test_a_reversed_flow_leads_back(H: Array) -> None:
    flow = true_flow(H)
    assert np.percentile(way_back_error(flow, reverse(flow)), 99) < 0.02


@pytest.mark.parametrize("H", [shift(6.3, -3.6), ZOOM], ids=["shift", "zoom"])
def test_the_flow_back_is_the_inverse_of_a_right_one(H: Array) -> None:
    backward = backward_flow(*grey_pair(H), true_flow(H))
    error = np.linalg.norm(backward - true_flow(np.linalg.inv(H)), axis=-1)
    visible = inside(pixel_centres() + true_flow(np.linalg.inv(H)), 8.0)
    assert np.median(error[visible]) < 0.1
    assert np.percentile(error[visible], 95) < 0.4


def test_a_flow_that_is_pixels_off_is_not_confirmed() -> None:
    """The pictures move by 6 px; a flow that is 3 px off is led back to somewhere else."""
    pair, wrong = grey_pair(shift(6.0, 0.0)), true_flow(shift(9.0, 0.0))
    assert np.median(way_back_error(wrong, backward_flow(*pair, wrong))) > 2.0


def test_an_error_of_the_flow_does_not_come_back_with_it() -> None:
    """An error in one place of the flow shows as a way back that ends elsewhere."""
    bump = np.zeros((HEIGHT, WIDTH), np.float32)
    bump[HEIGHT // 2, WIDTH // 2] = 1.0
    bump = cv2.GaussianBlur(bump, (0, 0), 12.0)
    bump *= 2.0 / bump.max()
    wrong = true_flow(shift(6.0, 2.0))
    wrong[..., 0] += bump
    backward = backward_flow(*grey_pair(shift(6.0, 2.0)), wrong)
    assert np.linalg.norm(backward - (-6.0, -2.0), axis=-1)[60:120, 80:160].max() < 0.5
