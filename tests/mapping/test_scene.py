"""The scene: pictures through water and shading, and a fit of the water that keeps them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from mapping_scenes import filmed, floor, gaussians_at, pose, renderer, view_of, water

from aquaflow.config import MediumConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.views import View

NEAR_AND_FAR = [pose((0.02 * i, 0.0, -0.35 * i)) for i in range(5)]
BLANK = view_of(np.zeros((48, 64, 3), np.uint8))


def scene(enabled: bool = True) -> Scene:
    config = MediumConfig(enabled=enabled)
    return Scene(config, renderer(), torch.Generator().manual_seed(0))


def random() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def submerged() -> tuple[Scene, list[View]]:
    """A map of a floor coloured as if there were little water, and pictures through more."""
    floating = scene()
    floor_map = floor(columns=18, rows=14)
    views = filmed(floor_map, NEAR_AND_FAR, water(beta=0.3, b=0.3))
    murk, z = water(beta=0.3, b=0.3), floor_map.means.norm(dim=-1)
    weak = floating.water(views[0])
    assert weak is not None
    seen = floor_map.colours * murk.transmission(z) + murk.backscatter(z)
    coloured, _ = weak.restore(seen.detach(), z)
    floating.gaussians = gaussians_at(floor_map.means, coloured.detach(), 0.09)
    return floating, views


def test_a_fit_takes_on_the_water_keeps_the_near_picture_and_improves_the_far_one() -> None:
    fitted, views = submerged()
    before = [fitted.show(view) for view in views]
    estimate = fitted.fit_water(views, random())
    assert estimate is not None
    after = [fitted.show(view) for view in views]
    assert float((after[0].image - before[0].image).abs().mean()) < 0.01
    assert float((after[0].radiance - before[0].radiance).abs().mean()) > 0.03
    wrong, right = (
        (shown[-1].image - views[-1].target()).abs().mean() for shown in (before, after)
    )
    assert float(right) < 0.7 * float(wrong)
    new = fitted.water(views[0])
    assert new is not None
    np.testing.assert_allclose(new.beta_a.detach(), estimate.beta_a, rtol=1e-4)
    assert fitted.beta_a_sigma == estimate.beta_a_sigma.tolist()


def test_nothing_is_fitted_without_water_views_gaussians_or_points() -> None:
    ready, views = submerged()
    dry = scene(enabled=False)
    dry.gaussians = ready.gaussians
    assert dry.fit_water(views, random()) is None
    told_not_to = Scene(MediumConfig(fit=False), renderer(), random())
    told_not_to.gaussians = ready.gaussians
    assert told_not_to.fit_water(views, random()) is None
    assert ready.fit_water([], random()) is None
    assert scene().fit_water(views, random()) is None
    colours = ready.gaussians.parameters["raw_colours"].clone()
    ready.gaussians.keep(torch.arange(len(ready.gaussians)) < 50)
    assert ready.fit_water(views, random()) is None
    assert torch.equal(ready.gaussians.parameters["raw_colours"], colours[:50])
    assert ready.beta_a_sigma is None


def test_water_that_is_switched_off_is_not_there() -> None:
    dry = scene(enabled=False)
    dry.gaussians = floor()
    shown = dry.show(BLANK)
    assert dry.water(BLANK) is None
    assert torch.equal(shown.image, shown.radiance)
    restored, recoverable = dry.restore(BLANK, torch.ones(48, 64))
    assert torch.equal(restored, BLANK.target())
    assert recoverable.all()


def test_range_is_along_the_ray_and_the_same_with_and_without_water() -> None:
    for enabled in (True, False):
        wet = scene(enabled)
        wet.gaussians = floor(columns=40, rows=30, scale=0.04)
        z = wet.show(BLANK).z
        rays = BLANK.camera.unproject(BLANK.camera.pixel_centres())
        wanted = 2.0 * np.linalg.norm(rays, axis=-1)
        np.testing.assert_allclose(z[4:-4, 4:-4], wanted[4:-4, 4:-4], rtol=0.02)


def test_shading_multiplies_the_picture_and_restoring_divides_by_it() -> None:
    lit = scene(enabled=False)
    lit.gaussians = floor()
    plain = lit.show(BLANK)
    assert lit.gain(BLANK) is None
    lit.shading = np.array([0.2, 0.0, -0.4, 0.0, -0.4])
    gain = lit.gain(BLANK)
    assert gain is not None
    shaded = lit.show(BLANK)
    torch.testing.assert_close(shaded.image, plain.image * gain[..., None])
    assert torch.equal(shaded.radiance, plain.radiance)
    grey = view_of(np.full((48, 64, 3), 102, np.uint8))
    restored, _ = lit.restore(grey, torch.ones(48, 64))
    torch.testing.assert_close(restored, 0.4 / gain[..., None].expand(48, 64, 3))


def test_every_picture_size_has_its_own_shading() -> None:
    lit = scene(enabled=False)
    lit.shading = np.array([0.2, 0.0, -0.4, 0.0, -0.4])
    small = view_of(np.zeros((20, 30, 3), np.uint8), camera=CameraModel(30, 20, 25, 25, 15, 10))
    for view, size in ((BLANK, (48, 64)), (small, (20, 30)), (BLANK, (48, 64))):
        gain = lit.gain(view)
        assert gain is not None
        assert tuple(gain.shape) == size
    assert lit.gain(BLANK) is lit.gain(BLANK)


@pytest.mark.parametrize("enabled", [True, False])
def test_an_empty_scene_shows_open_water_or_black(enabled: bool) -> None:
    empty = scene(enabled)
    shown = empty.show(BLANK)
    sea = empty.water(BLANK)
    wanted = torch.zeros(3) if sea is None else sea.B_inf.detach()
    torch.testing.assert_close(shown.image, wanted.expand(48, 64, 3))
    assert not shown.alpha.any()
    assert torch.isfinite(shown.z).all()
