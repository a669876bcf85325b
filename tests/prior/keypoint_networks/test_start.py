"""From single matches to a displacement of the whole picture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.prior.flow import pixel_grid
from aquaflow.prior.keypoint_networks.keypoint_prior import flow_from_matches

WIDTH, HEIGHT = 240, 180
TURN = np.array([[0.97, -0.17, 40.0], [0.17, 0.97, -12.0], [2e-4, 1e-4, 1.0]])

Float = npt.NDArray[np.float32]


def places(count: int, seed: int = 0) -> Float:
    rng = np.random.default_rng(seed)
    return rng.uniform(2.0, (WIDTH - 2.0, HEIGHT - 2.0), (count, 2)).astype(np.float32)


def turned(pixels: Float) -> Float:
    mapped = pixels @ TURN[:, :2].T + TURN[:, 2]
    return (mapped[..., :2] / mapped[..., 2:]).astype(np.float32)


def test_matches_of_a_plane_give_its_displacement_everywhere() -> None:
    here = places(200)
    flow = flow_from_matches(here, turned(here), HEIGHT, WIDTH)
    assert flow is not None
    grid = pixel_grid(HEIGHT, WIDTH)
    assert np.abs(grid + flow - turned(grid)).max() < 0.1


def test_wrong_matches_among_right_ones_change_little() -> None:
    here = places(300)
    there = turned(here)
    there[::2] = places(150, seed=1)
    flow = flow_from_matches(here, there, HEIGHT, WIDTH)
    assert flow is not None
    grid = pixel_grid(HEIGHT, WIDTH)
    assert np.quantile(np.linalg.norm(grid + flow - turned(grid), axis=-1), 0.9) < 2.0


def test_what_stands_nearer_moves_further() -> None:
    here = places(800)
    near = (np.abs(here - (120, 90)) < 30).all(1)
    there = here + np.where(near[:, None], (16.0, 0.0), (10.0, 0.0)).astype(np.float32)
    flow = flow_from_matches(here, there, HEIGHT, WIDTH)
    assert flow is not None
    assert abs(flow[90, 120, 0] - 16.0) < 0.5
    assert abs(flow[90, 20, 0] - 10.0) < 0.5


def test_few_matches_or_matches_without_a_common_motion_give_no_flow() -> None:
    here = places(11)
    assert flow_from_matches(here, here, HEIGHT, WIDTH) is None
    assert flow_from_matches(places(40), places(40, seed=1), HEIGHT, WIDTH) is None
