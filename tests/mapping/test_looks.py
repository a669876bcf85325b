"""Gaussians look the same to the views that see them, whatever water is found in front of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.looks import Looks, recoloured
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.tiles import TileFiles
from aquaflow.render.contract import radiance
from aquaflow.render.views import View
from tests.mapping.mapping_scenes import (
    FLOOR_M,
    filmed,
    fit_water,
    flat_pointmap,
    floor,
    picture,
    pose,
    renderer,
    settings,
    view_of,
    water,
)

pytestmark = pytest.mark.usefixtures("contained", "one_thread")


def of_water(beta: float, z: Tensor) -> Looks:
    sea = water(beta)
    return Looks(sea.transmission(z), sea.backscatter(z))


def test_colours_in_other_water_look_the_same() -> None:
    rng = torch.Generator().manual_seed(0)
    raw, z = torch.rand(500, 3, generator=rng), 3.0 * torch.rand(500, generator=rng)
    before, after = of_water(0.1, z), of_water(0.3, z)
    new = radiance(recoloured(raw, before, after))
    seen = before.factor * radiance(raw) + before.veil
    visible = ((seen > after.veil + 1e-3) & (new < 2.0)).all(dim=1)
    assert visible.float().mean() > 0.5
    error = after.factor * new + after.veil - seen
    assert error[visible].abs().max() < 1e-5


def test_in_the_same_water_they_are_the_same_bit_for_bit() -> None:
    raw, z = torch.randn(500, 3), 9.0 * torch.rand(500)
    assert torch.equal(recoloured(raw, of_water(0.4, z), of_water(0.4, z)), raw)


def test_where_hardly_any_light_arrives_they_stay_in_bounds() -> None:
    raw, z = torch.rand(500, 3), torch.full((500,), 50.0)
    new = radiance(recoloured(raw, of_water(0.01, z), of_water(1.0, z)))
    assert torch.isfinite(new).all()
    assert new.max() <= 2.0 + 1e-5


# --- maps -----------------------------------------------------------------------------------------


def along(start: int, count: int) -> list[Sim3]:
    """Poses along a line above the floor, of which each shows mostly what the one before does."""
    return [pose((0.1 * i - 0.4, 0.0, 0.0)) for i in range(start, start + count)]


def mapped(files: TileFiles | None, beta: float, poses: list[Sim3], first: int = 0) -> Mapper:
    """A map of pictures in water that it knows; each is a keyframe's."""
    mapper = Mapper(settings(medium={"fit": False}), renderer(), 0, tiles=files)
    set_water(mapper, beta)
    for i, T_wc in enumerate(poses, first):
        view = view_of(picture(floor(), T_wc, water(beta)), T_wc, i)
        view.keyframe = i
        mapper.add_view(view)
        mapper.insert(view, flat_pointmap())
    mapper.optimise(40)
    return mapper


def set_water(mapper: Mapper, beta: float) -> None:
    sea = water(beta)
    mapper.medium.set_water(sea.beta_a, sea.B_inf, sea.b)


def change_of(mapper: Mapper, views: list[View], change: Callable[[], None]) -> float:
    """Mean absolute difference in the pictures of ``views``."""
    before = [mapper.show(view).image for view in views]
    change()
    differences = [mapper.show(v).image - b for v, b in zip(views, before, strict=True)]
    return float(torch.stack(differences).abs().mean())


def test_what_waited_while_other_water_was_found_looks_the_same(tmp_path: Path) -> None:
    mapper = mapped(TileFiles(tmp_path), 0.2, along(0, 4))
    numbers = sorted(set(mapper.gaussians.keyframes.tolist()))

    def come_back() -> None:
        mapper._release(numbers)
        set_water(mapper, 0.4)
        mapper.gather()

    assert change_of(mapper, mapper.views, lambda: set_water(mapper, 0.4)) > 0.05
    set_water(mapper, 0.2)
    assert change_of(mapper, mapper.views, come_back) < 0.004


def test_what_waited_while_exposures_changed_looks_the_same(tmp_path: Path) -> None:
    mapper = mapped(TileFiles(tmp_path), 0.2, along(0, 4))
    mapper.scene.exposes = True
    numbers = sorted(set(mapper.gaussians.keyframes.tolist()))

    def brighter() -> None:
        for view in mapper.views:
            view.log_gain = view.log_gain + 0.2

    def come_back() -> None:
        mapper._release(numbers)
        brighter()
        mapper.gather()

    assert change_of(mapper, mapper.views, come_back) < 0.004
    assert change_of(mapper, mapper.views, brighter) > 0.05


def test_what_waited_while_the_maps_unit_changed_looks_the_same(tmp_path: Path) -> None:
    mapper = mapped(TileFiles(tmp_path), 0.2, along(0, 4))
    numbers = sorted(set(mapper.gaussians.keyframes.tolist()))

    def come_back() -> None:
        mapper._release(numbers)
        mapper.move({i: Sim3(np.eye(3), np.zeros(3), 1.5) for i in range(4)})
        set_water(mapper, 0.3)
        mapper.gather()

    assert change_of(mapper, mapper.views, come_back) < 0.006


def test_the_water_follows_the_maps_unit() -> None:
    mapper = mapped(None, 0.2, along(0, 3))
    double = {i: Sim3(np.eye(3), np.zeros(3), 2.0) for i in range(3)}
    assert change_of(mapper, mapper.views, lambda: mapper.move(double)) < 1e-3
    beta_a = mapper.medium(torch.eye(3)).beta_a
    assert beta_a.tolist() == pytest.approx((0.5 * water(0.2).beta_a).tolist(), rel=0.1)


def test_a_map_that_is_absorbed_looks_to_its_views_as_in_its_own_water(tmp_path: Path) -> None:
    files = TileFiles(tmp_path)
    mapper, other = mapped(files, 0.2, along(0, 2)), mapped(files, 0.4, along(6, 3), first=6)
    shift = {i: Sim3(np.eye(3), np.array([50.0, 0.0, 0.0]), 0.8) for i in range(6, 9)}
    before = [other.show(view).image for view in other.views]
    other.move(shift)
    other._release([7])
    mapper.absorb(other)
    mapper.gather()
    found = [mapper.show(view).image for view in other.views]
    error = torch.stack([a - b for a, b in zip(found, before, strict=True)]).abs().mean()
    assert error < 0.004
    assert mapper.water_fitting.next_fit <= len(mapper.views)


def test_another_fit_keeps_the_pictures_of_ground_that_it_did_not_look_at() -> None:
    mapper = Mapper(settings(medium={"enabled": True}), renderer(), 0)
    mapper.scene.gaussians = floor(columns=18, rows=14)
    near = [pose((0.02 * i, 0.0, -0.35 * i)) for i in range(5)]
    sea = water(beta=0.3, b=0.3)
    looked_at = filmed(mapper.gaussians, near, sea)
    far = floor(columns=18, rows=14)
    far.parameters["means"] += torch.tensor([30.0, 0.0, 0.0])
    mapper.gaussians.append(far)
    there = filmed(mapper.gaussians, [pose((30.0, 0.0, 0.2))], sea)[0]
    there.frame_index, dive = 9, [*looked_at, there]

    def fit() -> None:
        drawn = torch.Generator().manual_seed(0)
        estimate = fit_water(mapper.scene, looked_at, drawn, dive)
        assert estimate is not None
        assert estimate.model.water

    assert mapper.scene.nearest_cameras(looked_at)[1].max() > 10.0 * FLOOR_M
    assert change_of(mapper, [there], fit) < 0.01
