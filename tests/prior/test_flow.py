"""Dense flow: known motions come back, and what cannot be matched is not claimed."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.prior.flow import (
    BORDER_PX,
    FlowMatcher,
    ImageFlow,
    check,
    check_by_numpy,
    confidence,
    normalised_grey,
    pixel_grid,
    sample,
)
from aquaflow.prior.flow import texture as texture_of
from tests.prior.textured_pictures import (
    HEIGHT,
    WIDTH,
    Picture,
    inside,
    lookup,
    mapped,
    moved_pair,
    pixel_centres,
    rgb,
    shift,
    texture,
)


def flow_between(a: Picture, b: Picture, start: np.ndarray | None = None) -> ImageFlow:
    grey_a, grey_b = normalised_grey(a), normalised_grey(b)
    return FlowMatcher()(grey_a, grey_b, texture_of(grey_a), texture_of(grey_b), start)


@pytest.mark.parametrize("move", [(0.0, 0.0), (0.3, -0.45), (6.4, 3.7), (-14.25, 9.5)])
def test_a_known_subpixel_shift_comes_back(move: tuple[float, float]) -> None:
    flow = flow_between(*moved_pair(shift(*move)))
    assert flow.share > 0.8
    error = np.linalg.norm(flow.forward[flow.valid] - move, axis=-1)
    assert np.median(error) < 0.15
    assert np.percentile(error, 95) < 0.4


def test_a_known_homography_comes_back() -> None:
    H = np.array([[1.04, -0.06, 5.0], [0.05, 0.97, -4.0], [1e-4, -1e-4, 1.0]])
    flow = flow_between(*moved_pair(H))
    grid = pixel_centres()
    error = np.linalg.norm(grid + flow.forward - mapped(H, grid), axis=-1)[flow.valid]
    assert flow.share > 0.75
    assert np.median(error) < 0.15
    assert np.percentile(error, 95) < 0.6


def test_the_stated_error_is_the_way_forward_and_back() -> None:
    flow = flow_between(*moved_pair(shift(5.0, 2.0)))
    target = pixel_grid(HEIGHT, WIDTH) + flow.forward
    back = sample(flow.backward, target)
    error = np.linalg.norm(flow.forward + back, axis=-1)
    # OpenCV reads between pixels at 32 places only.
    np.testing.assert_allclose(flow.error, error, atol=0.03)


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (97, 61), (1, 1)])
def test_compiled_code_checks_a_flow_as_numpy_does(size: tuple[int, int]) -> None:
    random, (width, height) = np.random.default_rng(0), size
    there = random.normal(0.0, 4.0, (height, width, 2)).astype(np.float32)
    back = np.full_like(there, 0.3)
    textures = random.uniform(0.0, 90.0, (2, height, width)).astype(np.float32)
    there[random.random((height, width)) < 0.5] = -0.3
    there[random.random((height, width)) < 0.05] = np.nan
    error, valid = check(there, back, textures[0], np.full_like(textures[1], 60.0))
    expected, valid_by_numpy = check_by_numpy(
        there, back, textures[0], np.full_like(textures[1], 60.0)
    )
    np.testing.assert_allclose(error, expected, atol=1e-4)
    np.testing.assert_array_equal(valid, valid_by_numpy)


def test_flows_and_textures_of_two_sizes_are_refused() -> None:
    flow, texture = np.zeros((20, 30, 2), np.float32), np.zeros((20, 30), np.float32)
    with pytest.raises(ValueError, match="one size"):
        check(flow, flow[1:], texture, texture)


def test_what_left_the_picture_is_mostly_not_matched() -> None:
    start = np.broadcast_to(np.float32([40.0, 0.0]), (HEIGHT, WIDTH, 2))
    flow = flow_between(*moved_pair(shift(40.0, 0.0)), start)
    left = pixel_centres()[..., 0] > WIDTH - 40.0 + BORDER_PX
    assert flow.valid[left].mean() < 0.1
    assert flow.valid[~left].mean() > 0.8


def test_what_something_else_covers_is_mostly_not_matched() -> None:
    a, b = moved_pair(shift(3.0, 1.0))
    cover = rgb(lookup(texture(9), pixel_centres()))
    covered = b.copy()
    covered[60:120, 80:160] = cover[60:120, 80:160]
    flow = flow_between(a, covered)
    assert flow.valid[66:112, 84:150].mean() < 0.35
    assert flow.valid[:40].mean() > 0.8


def test_pixels_without_texture_are_not_matched() -> None:
    field = texture(0)
    grid = pixel_centres()
    a, b = rgb(lookup(field, grid)), rgb(lookup(field, grid))
    a[15:165, 20:220] = b[15:165, 20:220] = 90
    flow = flow_between(a, b)
    assert not flow.valid[75:105, 100:140].any()
    assert flow.valid[:10, 10:-10].mean() > 0.7


@pytest.mark.parametrize("value", [0, 128, 255])
def test_pictures_of_one_colour_match_nowhere(value: int) -> None:
    flat = np.full((HEIGHT, WIDTH, 3), value, np.uint8)
    flow = flow_between(flat, flat)
    assert not flow.valid.any()
    assert np.isfinite(flow.forward).all()


def test_a_textured_picture_does_not_match_a_black_one() -> None:
    a, _ = moved_pair(shift(0.0, 0.0))
    assert not flow_between(a, np.zeros_like(a)).valid.any()
    assert not flow_between(np.zeros_like(a), a).valid.any()


def test_a_start_rescues_a_shift_that_plain_flow_loses() -> None:
    move = (0.3 * WIDTH, 0.0)
    pair = moved_pair(shift(*move))
    start = np.broadcast_to(np.float32(move), (HEIGHT, WIDTH, 2))
    plain, started = flow_between(*pair), flow_between(*pair, start)
    assert plain.share < 0.3
    assert started.share > 0.55
    assert np.median(np.linalg.norm(started.forward[started.valid] - move, axis=-1)) < 0.1


def test_the_start_is_not_written_to() -> None:
    start = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow_between(*moved_pair(shift(6.0, 0.0)), start)
    assert not start.any()


def test_a_start_that_is_no_number_counts_as_none() -> None:
    pair = moved_pair(shift(6.0, 0.0))
    start = np.full((HEIGHT, WIDTH, 2), np.nan, np.float32)
    np.testing.assert_array_equal(flow_between(*pair, start).forward, flow_between(*pair).forward)


def test_a_flow_without_a_start_does_not_remember_an_earlier_one() -> None:
    a, b = (normalised_grey(picture) for picture in moved_pair(shift(3.0, 1.0)))
    textures = (texture_of(a), texture_of(b))
    far = np.full((HEIGHT, WIDTH, 2), 40.0, np.float32)
    matcher = FlowMatcher()
    matcher(a, b, *textures, far)
    again = matcher(a, b, *textures)
    assert np.array_equal(again.forward, FlowMatcher()(a, b, *textures).forward)


def test_low_contrast_is_matched_like_high_contrast() -> None:
    a, b = moved_pair(shift(4.0, -2.0))
    dim_a, dim_b = (np.uint8(20) + image // 8 for image in (a, b))
    flow = flow_between(dim_a, dim_b)
    assert flow.share > 0.6
    assert np.median(np.linalg.norm(flow.forward[flow.valid] - (4.0, -2.0), axis=-1)) < 0.3


def test_sampling_interpolates_and_repeats_the_border() -> None:
    field = np.float32([[0.0, 1.0], [2.0, 3.0]])
    pixels = np.float32([[[0.5, 0.5], [1.0, 0.5], [1.0, 1.0], [-9.0, -9.0], [9.0, 9.0]]])
    np.testing.assert_allclose(sample(field, pixels)[0], [0.0, 0.5, 1.5, 0.0, 3.0], atol=1e-3)


def test_inside_of_these_tests_agrees_with_the_matcher_border() -> None:
    flow = flow_between(*moved_pair(shift(0.0, 0.0)))
    target = pixel_centres() + flow.forward
    assert not (flow.valid & ~inside(target, BORDER_PX)).any()


def perfect(forward: np.ndarray) -> ImageFlow:
    shape = forward.shape[:2]
    everywhere = np.ones(shape, dtype=bool)
    return ImageFlow(forward, -forward, np.zeros(shape, np.float32), everywhere)


def test_a_match_is_less_certain_beside_an_edge_of_the_flow() -> None:
    forward = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    forward[:, WIDTH // 2 :, 0] = 2.0
    certain = confidence(perfect(forward))
    assert (certain[:, : WIDTH // 2 - 8] == 1.0).all()
    assert (certain[:, WIDTH // 2 - 1 : WIDTH // 2 + 1] < 0.05).all()


def test_a_turning_growing_flow_without_edges_is_certain() -> None:
    grid = pixel_grid(HEIGHT, WIDTH)
    forward = grid @ np.array([[0.05, -0.3], [0.3, 0.05]], np.float32)
    certain = confidence(perfect(forward))
    assert certain[8:-8, 8:-8].min() > 0.99


def test_confidence_does_not_depend_on_where_its_arrays_lie() -> None:
    """Or a replay would not repeat: memory lies elsewhere in every process."""
    rng = np.random.default_rng(3)
    forward = rng.normal(0.0, 2.0, (60, 90, 2)).astype(np.float32)
    found = set()
    for offset in range(0, 64, 4):
        room = np.empty(forward.nbytes + 128, np.uint8)
        first = -room.ctypes.data % 64 + offset
        moved = room[first : first + forward.nbytes].view(np.float32).reshape(forward.shape)
        moved[:] = forward
        kept = np.empty(1 + 997 * offset, np.uint8)  # what is made next lies elsewhere
        found.add(confidence(perfect(moved)).tobytes())
        del kept
    assert len(found) == 1


def test_what_is_not_matched_has_no_confidence() -> None:
    forward = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow = perfect(forward)
    flow.valid[3:5] = False
    assert (confidence(flow)[3:5] == 0.0).all()
