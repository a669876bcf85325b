"""The map's own colours without water: bounded like those of restored pictures, wherever shown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from aquaflow.config import Config, MappingConfig
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.map_file import summarise_water
from aquaflow.dive.ply import read_ply
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import (
    drawn_without_water,
    mean_water,
    restored_gaussians,
    restored_radiance,
)
from aquaflow.mapping.state import copy_map
from aquaflow.render.contract import radiance
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.white_balance import WhiteBalance
from tests.mapping.mapping_scenes import CAMERA, floor, pose, renderer, view_of

WATER = ((0.9, 0.15, 0.1), (0.05, 0.25, 0.3), (0.5, 0.3, 0.2))
"""Red is gone after a few units."""
BALANCE = WhiteBalance(1.0, (0.4, 0.4, 0.4), (1.1, 0.9, 1.0), 0.15)
BLANK = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)


def mapped(balance: WhiteBalance | None = BALANCE) -> Mapper:
    mapper = Mapper(MappingConfig(), renderer(), seed=0)
    mapper.scene.gaussians = floor()
    mapper.medium.set_water(*(torch.tensor(values) for values in WATER))
    mapper.scene.balance = balance
    places = ((0.0, 0.0, 0.0), (0.0, 0.0, -3.0))
    mapper.views = [view_of(BLANK, pose(at), index) for index, at in enumerate(places)]
    return mapper


def test_far_colours_are_amplified_no_more_than_the_posterior_allows() -> None:
    scene = mapped().scene
    water = mean_water(scene, mapped().views)
    assert water is not None
    z = torch.linspace(0.2, 12.0, 60)
    J, brighter = torch.full((60, 3), 0.4), torch.full((60, 3), 0.4)
    brighter[:, 0] += 0.01
    first, second = (restored_radiance(scene, each, z, water) for each in (J, brighter))
    light = 0.01 * water.transmission(z)[:, 0]
    amplified = (second.picture - first.picture)[:, 0] / light
    assert second.allowed is not None
    assert bool((amplified <= 1.01 * second.allowed[:, 0] + 1e-3).all())
    assert float(amplified.max()) > 1.5
    assert float(1.0 / water.transmission(z)[-1, 0]) > 1e3  # what J itself was amplified by


def test_red_that_no_light_vouches_for_follows_the_other_channels() -> None:
    scene = mapped().scene
    water = mean_water(scene, mapped().views)
    ruddy = torch.tensor([[1.6, 0.4, 0.4], [1.6, 0.4, 0.4]])
    near, far = restored_radiance(scene, ruddy, torch.tensor([0.3, 10.0]), water).picture
    assert float(near[0] / near[1]) > 3.0
    assert float(far[0] / far[1]) < 1.5


def test_before_the_first_fit_and_in_clear_water_they_are_the_maps_own() -> None:
    mapper = mapped(balance=None)
    J = radiance(mapper.gaussians.parameters["raw_colours"])
    torch.testing.assert_close(restored_gaussians(mapper.scene, J, mapper.views), J)
    far = torch.tensor([12.0])
    water = mean_water(mapper.scene, mapper.views)
    lost = restored_radiance(mapper.scene, torch.ones(1, 3), far, water)
    assert float(lost.picture[0, 0]) < 1e-2
    assert not float(lost.confidence)
    mapper.medium.active = False
    assert mean_water(mapper.scene, mapper.views) is None
    assert restored_gaussians(mapper.scene, J, mapper.views) is J
    assert mean_water(mapped().scene, []) is None


def test_a_gaussian_is_restored_from_where_it_was_seen_nearest() -> None:
    mapper = mapped()
    J = radiance(mapper.gaussians.parameters["raw_colours"])
    both = restored_gaussians(mapper.scene, J, mapper.views)
    near = restored_gaussians(mapper.scene, J, mapper.views[:1])
    torch.testing.assert_close(both, near)
    far = restored_gaussians(mapper.scene, J, mapper.views[1:])
    assert float((far - near).abs().max()) > 0.05


def test_ply_viewer_and_frames_show_the_same_bounded_colours(tmp_path: Path) -> None:
    mapper = mapped()
    J = radiance(mapper.gaussians.parameters["raw_colours"])
    expected = restored_gaussians(mapper.scene, J, mapper.views).numpy()
    assert np.abs(expected - (J * torch.tensor(BALANCE.gain)).numpy()).max() > 0.02
    np.testing.assert_allclose(copy_map(mapper).clear, expected, atol=1e-6)
    folder = DiveFolder(tmp_path / "dive", Config())
    folder.write_splats(mapper, summarise_water(mapper), WorldFrame.unknown())
    np.testing.assert_allclose(read_ply(folder.path / "map_clear.ply").colours, expected, atol=1e-5)
    view = mapper.views[0]
    shown = mapper.show(view)
    drawn = drawn_without_water(mapper.scene, view, shown).image
    own = restored_radiance(
        mapper.scene, shown.radiance / shown.alpha[..., None], shown.z, mapper.scene.water(view)
    )
    solid = shown.alpha > 0.5
    assert float((drawn - own.picture * shown.alpha[..., None])[solid].abs().max()) < 1e-5
    assert own.amplification is not None
    assert own.allowed is not None
    assert bool((own.amplification <= own.allowed * 1.0001)[solid].all())


@pytest.mark.parametrize("z", [0.0, 1e-6, 1e6])
def test_any_range_gives_finite_colours(z: float) -> None:
    scene = mapped().scene
    water = mean_water(scene, mapped().views)
    found = restored_radiance(scene, torch.full((1, 3), 0.5), torch.tensor([z]), water)
    assert bool(torch.isfinite(found.picture).all())
    assert bool(torch.isfinite(found.confidence).all())
