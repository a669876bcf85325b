"""Coarse flow: what most cells agree on is found, what they do not agree on is not claimed."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.prior import hybrid as coarse
from aquaflow.prior.hybrid import coarse_flow, mutual_matches
from aquaflow.prior.network import unit

Float = npt.NDArray[np.float32]

ROWS, COLUMNS, CELL_PX = 18, 24, 8
MARGIN = 16
HEIGHT, WIDTH = ROWS * CELL_PX, COLUMNS * CELL_PX


def plane() -> Float:
    """[ROWS + 2 MARGIN, COLUMNS + 2 MARGIN, 32] smooth random descriptors, not normalised."""
    rng = np.random.default_rng(0)
    shape = (ROWS + 2 * MARGIN, COLUMNS + 2 * MARGIN, 32)
    return cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), 0.9)


def seen(A: npt.NDArray[np.float64]) -> Float:
    """[ROWS, COLUMNS, 32] the plane's descriptors where cell x shows A (x, 1), in cells."""
    y, x = np.mgrid[:ROWS, :COLUMNS] + 0.5
    at = (np.stack([x, y, np.ones_like(x)], -1) @ A.T + MARGIN - 0.5).astype(np.float32)
    found = cv2.remap(plane(), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    return unit(found)


STILL = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def moved(dx: float, dy: float) -> npt.NDArray[np.float64]:
    """What b's cells show where everything moved by (dx, dy) cells from a to b."""
    return np.array([[1.0, 0.0, -dx], [0.0, 1.0, -dy]])


def in_view(
    shape: tuple[int, ...], move: tuple[float, float], margin: float
) -> npt.NDArray[np.bool_]:
    """[H, W]: the pixel's match lies so far inside the other picture."""
    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    x, y = u + CELL_PX * move[0], v + CELL_PX * move[1]
    across = (x > margin) & (x < shape[1] - margin)
    return across & (y > margin) & (y < shape[0] - margin)


@pytest.mark.parametrize("move", [(0.0, 0.0), (7.0, 0.0), (-4.5, 3.25), (10.0, -6.0)])
def test_a_shift_of_many_cells_comes_back(move: tuple[float, float]) -> None:
    flow = coarse_flow(seen(STILL), seen(moved(*move)), HEIGHT, WIDTH)
    assert flow is not None
    assert flow.shape == (HEIGHT, WIDTH, 2)
    error = np.linalg.norm(flow - CELL_PX * np.array(move), axis=-1)
    inside = in_view(flow.shape, move, 2 * CELL_PX)
    assert np.median(error[inside]) < 0.15 * CELL_PX
    assert np.percentile(error[inside], 95) < CELL_PX


def test_a_turn_with_a_change_of_scale_comes_back() -> None:
    angle, scale, middle = 0.35, 1.2, np.array([COLUMNS, ROWS]) / 2
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    flow = coarse_flow(
        seen(STILL),
        seen(np.column_stack([np.linalg.inv(turn), middle - np.linalg.inv(turn) @ middle])),
        HEIGHT,
        WIDTH,
    )
    assert flow is not None
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    there = (np.stack([u, v], -1) / CELL_PX - middle) @ turn.T + middle
    error = np.linalg.norm(CELL_PX * there - np.stack([u, v], -1) - flow, axis=-1)
    assert np.median(error) < 0.5 * CELL_PX
    assert np.percentile(error, 95) < 1.5 * CELL_PX


def test_unrelated_pictures_have_no_coarse_flow() -> None:
    rng = np.random.default_rng(1)
    a, b = (unit(rng.normal(size=(ROWS, COLUMNS, 32)).astype(np.float32)) for _ in range(2))
    assert coarse_flow(a, b, HEIGHT, WIDTH) is None


def test_wrong_cells_among_right_ones_do_no_harm() -> None:
    rng = np.random.default_rng(2)
    b = seen(moved(6.0, 0.0))
    wrong = rng.random((ROWS, COLUMNS)) < 0.4
    b[wrong] = unit(rng.normal(size=(int(wrong.sum()), 32)).astype(np.float32))
    flow = coarse_flow(seen(STILL), b, HEIGHT, WIDTH)
    assert flow is not None
    assert np.median(np.linalg.norm(flow - (6.0 * CELL_PX, 0.0), axis=-1)) < 0.5 * CELL_PX


def test_cells_of_one_picture_that_are_smaller_than_the_others_are_counted_in_its_own() -> None:
    fine = unit(cv2.resize(seen(STILL), (2 * COLUMNS, 2 * ROWS), interpolation=cv2.INTER_LINEAR))
    flow = coarse_flow(seen(STILL), fine, HEIGHT, WIDTH)
    assert flow is not None
    assert np.median(np.linalg.norm(flow, axis=-1)) < 0.5 * CELL_PX


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_descriptors_that_are_no_numbers_give_no_flow(bad: float) -> None:
    a = seen(STILL)
    a[3, 4, 0] = bad
    assert coarse_flow(a, seen(STILL), HEIGHT, WIDTH) is None


def test_cells_that_are_all_alike_give_no_flow_that_is_no_number() -> None:
    same = np.full((ROWS, COLUMNS, 4), 0.5, np.float32)
    displacement, _ = mutual_matches(same, same)
    assert np.isfinite(displacement).all()
    flow = coarse_flow(same, same, HEIGHT, WIDTH)
    assert flow is None or np.isfinite(flow).all()


def test_a_motion_that_is_no_number_is_no_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = (np.full((3, 3), np.nan), np.ones((400, 1), np.uint8))
    monkeypatch.setattr(coarse.cv2, "findHomography", lambda *_, **__: broken)
    assert coarse_flow(seen(STILL), seen(STILL), HEIGHT, WIDTH) is None


def test_on_the_horizon_of_the_motion_displacements_stay_finite(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the denominator is zero, in the picture's middle."""
    H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0 / 12.0, 0.0, 1.0]])
    everywhere = np.ones((ROWS * COLUMNS, 1), np.uint8)
    monkeypatch.setattr(coarse.cv2, "findHomography", lambda *_, **__: (H, everywhere))
    flow = coarse_flow(seen(STILL), seen(STILL), HEIGHT, WIDTH)
    assert flow is not None
    assert np.isfinite(flow).all()


def test_descriptors_of_two_networks_are_not_compared() -> None:
    assert coarse_flow(seen(STILL), seen(STILL)[..., :16], HEIGHT, WIDTH) is None
