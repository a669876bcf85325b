"""Drawing the Gaussians near a view makes the picture that all of them make."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aquaflow.config import MappingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.spatial_index import BLOCK, SpatialIndex
from aquaflow.render.views import View
from tests.mapping.mapping_scenes import gaussians_at, renderer

CAMERA = CameraModel(96, 64, 80.0, 78.0, 50.0, 30.0)
NO_PIXELS = np.zeros((0, 0, 3), np.uint8)


def scattered(count: int, side: float, seed: int = 0) -> Mapper:
    """Gaussians of all sizes in a cube around the origin."""
    rng = np.random.default_rng(seed)
    mapper = Mapper(MappingConfig(), renderer(), seed=0)
    means = torch.from_numpy(rng.uniform(-side, side, (count, 3)))
    mapper.scene.gaussians = gaussians_at(means, torch.from_numpy(rng.uniform(0, 1, (count, 3))), 1)
    parameters = mapper.gaussians.parameters
    sizes = rng.normal(np.log(0.03), 0.7, (count, 3))
    parameters["log_scales"] = torch.from_numpy(sizes.astype(np.float32))
    parameters["quats"] = torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32))
    parameters["opacity_logits"] = torch.from_numpy(rng.normal(size=(count, 1)).astype(np.float32))
    return mapper


def anywhere(rng: np.random.Generator, side: float) -> View:
    T_wc = Sim3(so3_exp(rng.normal(size=3)), rng.uniform(-side, side, 3))
    return View(0, NO_PIXELS, CAMERA, T_wc, 0, robust=False)


@pytest.mark.parametrize("seed", range(8))
def test_pictures_of_a_finished_map_are_the_same_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mapper = scattered(40 * BLOCK + 100, 4.0, seed)
    mapper.gaussians.parameters["means"][5] = float("nan")
    mapper.gaussians.parameters["log_scales"][7] = float("inf")
    views = [anywhere(rng, 5.0) for _ in range(6)]
    before = [mapper.show(view) for view in views]
    mapper.scene.finish()
    assert any(mapper.scene.near(view.camera, view.T_wc) is not None for view in views)
    for view, expected in zip(views, before, strict=True):
        shown = mapper.show(view)
        for name in ("image", "alpha", "z"):
            np.testing.assert_array_equal(getattr(shown, name), getattr(expected, name))


def test_a_view_of_a_long_map_touches_a_part_of_it_alone() -> None:
    rng = np.random.default_rng(0)
    count = 200_000
    means = rng.uniform((0.0, 0.0, 1.4), (400.0, 12.0, 1.8), (count, 3))
    index = SpatialIndex(means, np.full(count, 0.02))
    down = Sim3(np.eye(3), np.array([200.0, 6.0, 0.0]))
    rows = index.in_picture(CAMERA, down)
    assert 0 < len(rows) < 0.03 * count
    assert (np.diff(rows) > 0).all()


def test_a_box_holds_what_reaches_into_it() -> None:
    rng = np.random.default_rng(1)
    means = rng.uniform((-5.0, -5.0, 0.0), (5.0, 5.0, 0.3), (20_000, 3))
    sigmas = rng.uniform(0.01, 0.1, 20_000)
    low, high = np.array([-1.0, 0.0]), np.array([1.0, 3.0])
    rows = SpatialIndex(means, sigmas).in_box(low, high, 3.0)
    reach = 3.0 * sigmas[:, None]
    touch = ((means[:, :2] > low - reach) & (means[:, :2] < high + reach)).all(axis=1)
    assert set(np.flatnonzero(touch)) <= set(rows.tolist())
    assert len(rows) < 0.3 * len(means)


def test_a_map_that_goes_on_is_drawn_whole_again() -> None:
    mapper = scattered(40 * BLOCK, 4.0)
    view = anywhere(np.random.default_rng(3), 1.0)
    mapper.views = [view]
    mapper.scene.finish()
    assert mapper.scene.near(view.camera, view.T_wc) is not None
    mapper.move({0: Sim3(np.eye(3), np.array([9.0, 0.0, 0.0]))})
    assert mapper.scene.near(view.camera, view.T_wc) is None


def test_an_empty_map_has_nothing_near() -> None:
    index = SpatialIndex(np.zeros((0, 3)), np.zeros(0))
    assert len(index.in_picture(CAMERA, Sim3.identity())) == 0
    assert len(index.in_box(np.zeros(2), np.ones(2), 3.0)) == 0
