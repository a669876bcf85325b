"""Sub-pixel refinement: errors of a flow shrink, in the mean too, whatever the light does."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from aquaflow.prior.flow import (
    MAX_STEP_PX,
    Float,
    Grey,
    is_refinable,
    refine,
    refine_by_opencv,
)
from tests.prior.textured_pictures import (
    HEIGHT,
    WIDTH,
    Array,
    grey_pair,
    shift,
    true_flow,
)

ZOOM = np.array([[1.06, -0.03, -4.0], [0.03, 1.06, -6.0], [0.0, 0.0, 1.0]])
INNER = np.s_[15:-15, 20:-20]


def wavy_error(amplitude_px: float) -> Float:
    """[H, W, 2] an error that neighbouring pixels share, as half the resolution leaves one."""
    field = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 2))
    field = cv2.GaussianBlur(field, (0, 0), 8.0)
    return np.asarray(amplitude_px * field / field.std(), dtype=np.float32)


def noisy(grey: Grey, seed: int, sigma: float) -> Grey:
    noise = np.random.default_rng(seed).normal(0.0, sigma, grey.shape)
    return np.asarray(np.clip(np.rint(grey + noise), 0, 255), dtype=np.uint8)


@pytest.mark.parametrize("H", [shift(5.3, -2.6), ZOOM])
def test_an_error_that_neighbours_share_shrinks_to_a_third(H: Array) -> None:
    error = wavy_error(0.3)
    left = refine(*grey_pair(H), true_flow(H) + error) - true_flow(H)
    assert left[INNER].std() < 0.33 * error[INNER].std()


@pytest.mark.parametrize("H", [shift(5.3, -2.6), ZOOM])
def test_a_true_flow_stays_true_on_average(H: Array) -> None:
    left = refine(*grey_pair(H), true_flow(H)) - true_flow(H)
    assert np.abs(left[INNER].mean((0, 1))).max() < 0.01


def test_light_that_falls_off_across_the_picture_moves_nothing() -> None:
    a, b = grey_pair(shift(5.3, -2.6))
    shade = np.linspace(1.0, 0.4, WIDTH)
    dimmed = np.asarray(np.rint(b * shade + 20.0), dtype=np.uint8)
    left = refine(a, dimmed, true_flow(shift(5.3, -2.6))) - (5.3, -2.6)
    assert np.abs(left[INNER].mean((0, 1))).max() < 0.02


def test_noise_shortens_no_step() -> None:
    H, off = shift(5.3, -2.6), np.float32([0.4, -0.3])
    a, b = grey_pair(H)
    left = refine(noisy(a, 1, 20.0), noisy(b, 2, 20.0), true_flow(H) + off) - true_flow(H)
    # Gradients of one picture alone leave 0.10 px.
    assert np.abs(np.median(left[INNER], axis=(0, 1))).max() < 0.06


def test_without_texture_the_flow_stays_as_it_was() -> None:
    flat = np.full((HEIGHT, WIDTH), 90, np.uint8)
    flow = wavy_error(2.0)
    np.testing.assert_allclose(refine(flat, flat, flow), flow, atol=1e-5)


def test_no_step_is_longer_than_the_picture_is_linear() -> None:
    H = shift(5.3, -2.6)
    start = true_flow(H) + np.float32([9.0, 0.0])
    step = refine(*grey_pair(H), start) - start
    assert np.linalg.norm(step, axis=-1).max() < MAX_STEP_PX * 1.001


def test_a_picture_of_few_windows_is_not_refined() -> None:
    a, _ = grey_pair(shift(5.3, -2.6))
    assert is_refinable(a)
    assert not is_refinable(cv2.resize(a, (64, 48)))


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (97, 61), (8, 5), (1, 1)])
def test_compiled_code_refines_as_opencv_does(size: tuple[int, int]) -> None:
    a, b = (cv2.resize(grey, size) for grey in grey_pair(ZOOM))
    flow = cv2.resize(true_flow(ZOOM) + wavy_error(1.5), size)
    expected = refine_by_opencv(a, b, flow)
    np.testing.assert_allclose(refine(a, b, flow), expected, atol=2e-3)


@pytest.mark.parametrize("wild", [np.nan, np.inf, -np.inf, 1e30])
def test_a_flow_that_is_no_number_reads_nothing_outside_of_the_pictures(wild: float) -> None:
    a, b = grey_pair(ZOOM)
    flow = np.full((HEIGHT, WIDTH, 2), wild, np.float32)
    assert refine(a, b, flow).shape == flow.shape


def test_pictures_of_two_sizes_are_refused() -> None:
    a, b = grey_pair(ZOOM)
    with pytest.raises(ValueError, match="one size"):
        refine(a, b[1:], true_flow(ZOOM))
