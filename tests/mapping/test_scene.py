"""The scene: pictures through water and shading, and a fit of the water that keeps them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from aquaflow.config import MappingConfig, MediumConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.scene_water import rebalance
from aquaflow.mapping.state import deserialise, serialise
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.water.mounting import Lamp
from aquaflow.water.white_balance import ChosenWhite
from tests.mapping.mapping_scenes import (
    fit_water,
    floor,
    renderer,
    view_of,
)
from tests.mapping.water_scenes import in_clear_water, random, scene, submerged

BLANK = view_of(np.zeros((48, 64, 3), np.uint8))


def test_a_fit_takes_on_the_water_keeps_the_near_picture_and_improves_the_far_one() -> None:
    fitted, views = submerged()
    before = [fitted.show(view) for view in views]
    estimate = fit_water(fitted, views, random())
    assert estimate is not None
    after = [fitted.show(view) for view in views]
    assert float((after[0].image - before[0].image).abs().mean()) < 0.015
    assert float((after[0].radiance - before[0].radiance).abs().mean()) > 0.03
    wrong, right = (
        (shown[-1].image - views[-1].target()).abs().mean() for shown in (before, after)
    )
    assert float(right) < 0.7 * float(wrong)
    new = fitted.water(views[0])
    assert new is not None
    np.testing.assert_allclose(new.beta_a.detach(), estimate.beta_a, rtol=1e-4)
    assert fitted.beta_a_sigma == estimate.beta_a_sigma is not None


def test_nothing_is_fitted_when_told_not_to_or_without_views_gaussians_or_points() -> None:
    ready, views = submerged()
    told_not_to = Scene(MediumConfig(fit=False), renderer(), random())
    told_not_to.gaussians = ready.gaussians
    assert fit_water(told_not_to, views, random()) is None
    assert fit_water(ready, [], random()) is None
    assert fit_water(scene(), views, random()) is None
    colours = ready.gaussians.parameters["raw_colours"].clone()
    ready.gaussians.keep(torch.arange(len(ready.gaussians)) < 50)
    assert fit_water(ready, views, random()) is None
    assert torch.equal(ready.gaussians.parameters["raw_colours"], colours[:50])
    assert ready.beta_a_sigma is None


def test_in_clear_water_the_medium_goes_off_and_the_pictures_stay() -> None:
    dry, views = in_clear_water()
    before = dry.show(views[0]).image
    estimate = fit_water(dry, views, random())
    assert estimate is not None
    assert not dry.medium.active
    assert dry.water(views[0]) is None
    assert dry.water_evidence is not None
    assert float((dry.show(views[0]).image - before).abs().mean()) < 0.02


def test_a_medium_that_went_off_comes_on_again_when_the_water_shows() -> None:
    fitted, views = submerged()
    fitted.medium.active = False
    estimate = fit_water(fitted, views, random())
    assert estimate is not None
    found = fitted.water(views[0])
    assert found is not None
    np.testing.assert_allclose(found.beta_a.detach(), estimate.beta_a, rtol=1e-4)


def test_a_medium_that_may_not_go_off_stays_on() -> None:
    dry, views = in_clear_water()
    dry.config = MediumConfig(off_when_clear=False)
    assert fit_water(dry, views, random()) is not None
    assert dry.medium.active


def test_lamps_that_go_down_are_exposure_and_neither_water_nor_colour() -> None:
    dry, views = in_clear_water(dimmed_from=3)
    between = view_of(views[-1].image, views[-1].T_wc, 10)
    assert fit_water(dry, views, random(), [*views, between]) is not None
    assert dry.exposes
    assert not dry.medium.active
    gains = [float(view.log_gain.exp().mean()) for view in views]
    np.testing.assert_allclose(np.array(gains[3:]) / gains[0], 0.6, rtol=0.05)
    np.testing.assert_allclose(between.log_gain, views[-1].log_gain)
    errors = [float((dry.show(view).image - view.target()).abs().mean()) for view in views]
    assert max(errors) < 0.04  # 0.2 were the lamps not known


def test_restoring_takes_the_exposure_out_and_drawing_puts_it_in() -> None:
    lit = scene(enabled=False)
    lit.gaussians = floor()
    plain = lit.show(BLANK)
    dark = view_of(np.full((48, 64, 3), 51, np.uint8))
    dark.log_gain = torch.tensor([0.5, 0.5, 0.25], dtype=torch.float64).log()
    assert torch.equal(lit.show(dark).image, plain.image)  # no exposure has been found yet
    lit.exposes = True
    torch.testing.assert_close(
        lit.show(dark).image, plain.image * torch.tensor([0.5, 0.5, 0.25]), rtol=1e-5, atol=1e-6
    )
    restored, _ = lit.restore(dark, torch.ones(48, 64))
    wanted = torch.tensor([0.4, 0.4, 0.8]).expand(48, 64, 3)
    torch.testing.assert_close(restored, wanted, rtol=1e-4, atol=1e-5)


def test_a_view_learns_its_exposure_only_when_it_is_told_to() -> None:
    lit = scene(enabled=False)
    lit.gaussians = floor(columns=40, rows=30, scale=0.06)
    view = view_of((lit.show(BLANK).image.clamp(0, 1).numpy() * 127.5).round().astype(np.uint8))
    lit.exposes = True
    lit.show(view)
    assert not view.log_gain.any()
    lit.show(view, learn=True)
    np.testing.assert_allclose(view.log_gain.exp(), 0.5, rtol=0.02)


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


def test_a_map_is_drawn_by_a_lamps_light_and_its_picture_restored_from_it() -> None:
    lit = scene(enabled=True)
    lit.gaussians = floor(columns=40, rows=30, scale=0.04)
    plain = lit.show(BLANK)
    lit.lamp = Lamp(share=0.7, power=2.0, range=1.0)
    shown, water = lit.show(BLANK), lit.water(BLANK)
    assert water is not None
    assert torch.equal(shown.radiance, plain.radiance)
    by_lamp = water.transmission(shown.z) - replace(water, lamp=None).transmission(shown.z)
    torch.testing.assert_close(shown.image, plain.image + shown.radiance * by_lamp)
    J = torch.full((48, 64, 3), 0.6)
    z = torch.linspace(0.7, 2.0, 64).expand(48, 64)
    seen = (J * water.transmission(z) + water.backscatter(z)).detach()
    view = view_of(np.rint(255.0 * seen.numpy()).astype(np.uint8))
    restored, _ = lit.restore(view, z)
    torch.testing.assert_close(restored, J, atol=0.03, rtol=0.0)


def test_a_lamp_is_kept_with_the_map() -> None:
    mapper = Mapper(MappingConfig(), ReferenceRenderer(), 0)
    assert deserialise(*serialise(mapper), ReferenceRenderer()).scene.lamp is None
    mapper.scene.lamp = Lamp(share=0.7, power=2.0, range=1.0)
    assert deserialise(*serialise(mapper), ReferenceRenderer()).scene.lamp == mapper.scene.lamp


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


def test_after_steps_that_changed_the_medium_what_is_nearest_keeps_its_colours() -> None:
    fitted, views = submerged()
    fit_water(fitted, views, random())
    rebalance(fitted)
    assert fitted.balance is not None
    before = fitted.balance.gain
    with torch.no_grad():
        fitted.medium.output.bias[0] += 1.0  # red fades faster, so that J is redder
    rebalance(fitted)
    assert fitted.balance.gain[0] < 0.9 * before[0]
    assert fitted.balance.gain[2] == pytest.approx(before[2])


def test_views_whose_red_gain_drifted_do_not_turn_what_is_nearest_red() -> None:
    fitted, views = submerged()
    fit_water(fitted, views, random())
    rebalance(fitted)
    assert fitted.balance is not None
    before = fitted.balance.gain
    fitted.exposes = True
    for view in views:
        view.log_gain = torch.tensor([-0.2, 0.0, 0.0], dtype=torch.float64)
    rebalance(fitted)
    assert fitted.balance.gain[0] < 0.95 * before[0]


def test_a_white_balance_that_was_chosen_outlives_the_next_fit() -> None:
    fitted, views = submerged()
    fit_water(fitted, views, random())
    assert fitted.balance is not None
    chosen = ChosenWhite("neutral", (1.3, 0.9, 0.8), (0.1, 0.1, 0.1))
    fitted.balance = replace(fitted.balance, chosen=chosen)
    fit_water(fitted, views, random())
    assert fitted.balance.chosen == chosen


def test_a_scene_without_water_has_no_balance_to_mend() -> None:
    dry = scene()
    rebalance(dry)
    assert dry.balance is None


def test_the_nearest_camera_of_each_gaussian_is_found() -> None:
    ready, (first, *_) = submerged()
    places = np.random.default_rng(0).normal(size=(30, 3))
    views = [first.with_pixels(first.image, first.camera, None) for _ in places]
    for view, place in zip(views, places, strict=True):
        view.T_wc = Sim3(np.eye(3), place)
    centres, z, which = ready.nearest_cameras(views)
    away = np.linalg.norm(ready.gaussians.means.double().numpy()[:, None] - places, axis=2)
    np.testing.assert_array_equal(which.numpy(), away.argmin(axis=1))
    np.testing.assert_allclose(z.numpy(), away.min(axis=1), rtol=1e-6)
    np.testing.assert_allclose(centres.numpy(), places[which.numpy()], rtol=1e-6)
