"""Sea-thru's fit on known water, and what it refuses."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from aquaflow.lab.evaluation.water_peers import sea_thru
from aquaflow.lab.evaluation.water_peers.backscatter import backscatter, fit_backscatter
from aquaflow.lab.evaluation.water_peers.contract import NotRestoredError
from aquaflow.lab.evaluation.water_peers.sea_thru import (
    GEOMETRY,
    fit_attenuation,
    local_average,
    two_exponentials,
)
from tests.lab.evaluation.water_peers.scene import HazyScene, hazy_scene, matched_psnr

BETA, VEIL = (1.2, 0.6, 0.4), (0.1, 0.3, 0.4)


@pytest.fixture(scope="module")
def scene() -> HazyScene:
    return hazy_scene(BETA, VEIL)


def test_the_scene_without_water_comes_back_up_to_a_gain(scene: HazyScene) -> None:
    restored = sea_thru.restore(scene.seen, scene.z)
    assert matched_psnr(scene.seen, scene.clean) < 18.0
    assert matched_psnr(restored, scene.clean) > 27.0


def test_views_that_are_not_fitted_are_restored_too(
    scene: HazyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sea_thru, "FIT_VIEWS", 1)
    restored = sea_thru.restore(scene.seen, scene.z)
    assert matched_psnr(restored[1], scene.clean[1]) > 25.0


def test_the_unit_of_the_ranges_does_not_matter(scene: HazyScene) -> None:
    a, b = (sea_thru.restore(scene.seen, scene.z * unit) for unit in (1.0, 8.0))
    np.testing.assert_allclose(a, b, atol=1e-3)


def test_the_backscatter_is_found_from_black_patches(scene: HazyScene) -> None:
    z = scene.z.ravel().astype(np.float64)
    veil = fit_backscatter(scene.seen.reshape(-1, 3).astype(np.float64), z)
    at = np.array([0.6, 1.2, 2.0])
    true = np.array(VEIL) * (1.0 - np.exp(-np.array(BETA) * at[:, None]))
    np.testing.assert_allclose(backscatter(veil, at), true, atol=0.02)


def test_the_attenuation_explains_the_illumination() -> None:
    z = np.linspace(0.5, 2.0, 400)
    light = np.exp(-np.array([1.2, 0.6, 0.4]) * z[:, None])
    for rate, found in zip((1.2, 0.6, 0.4), fit_attenuation(light, z), strict=True):
        np.testing.assert_allclose(two_exponentials(found, z), rate, rtol=0.02)


def test_light_does_not_spread_over_a_step_in_range() -> None:
    direct = np.full((40, 60, 3), 0.1)
    direct[:, 30:] = 0.4
    z = np.where(np.arange(60) < 30, 0.5, 2.0) * np.ones((40, 1))
    light, ranges = local_average(direct, z, np.ones((40, 60), bool))
    np.testing.assert_allclose(light[ranges < 1.0], GEOMETRY * 0.1, rtol=1e-6)
    np.testing.assert_allclose(light[ranges > 1.0], GEOMETRY * 0.4, rtol=1e-6)


def test_light_is_averaged_where_ranges_are_alike() -> None:
    direct = np.random.default_rng(0).uniform(0.0, 0.4, (40, 60, 3))
    light, _ = local_average(direct, np.ones((40, 60)), np.ones((40, 60), bool))
    assert light.std() < 0.2 * GEOMETRY * direct.std()
    assert np.isclose(light.mean(), GEOMETRY * direct.mean(), rtol=0.02)


def test_pixels_without_range_are_black_and_change_nothing_else(scene: HazyScene) -> None:
    z = scene.z.copy()
    z[:, :, :8] = 0.0
    z[:, :, 8:10] = np.nan
    restored = sea_thru.restore(scene.seen, z)
    assert (restored[:, :, :10] == 0.0).all()
    assert matched_psnr(restored[:, :, 10:], scene.clean[:, :, 10:]) > 27.0


def test_a_view_without_any_range_costs_only_that_view(scene: HazyScene) -> None:
    z = scene.z.copy()
    z[1] = 0.0
    restored = sea_thru.restore(scene.seen, z)
    assert (restored[1] == 0.0).all()
    assert matched_psnr(restored[0], scene.clean[0]) > 25.0


def test_without_ranges_nothing_is_restored(scene: HazyScene) -> None:
    with pytest.raises(NotRestoredError, match="ranges of the held-out views"):
        sea_thru.restore(scene.seen, None)


def test_too_few_ranges_are_refused(scene: HazyScene) -> None:
    z = np.zeros_like(scene.z)
    z[0, :10] = 1.0
    with pytest.raises(NotRestoredError, match="pixels have a range"):
        sea_thru.restore(scene.seen, z)


def test_ranges_without_span_are_refused(scene: HazyScene) -> None:
    with pytest.raises(NotRestoredError, match="span less"):
        sea_thru.restore(scene.seen, np.full_like(scene.z, 1.5))


def test_black_pictures_are_refused(scene: HazyScene) -> None:
    with pytest.raises(NotRestoredError, match="too little light"):
        sea_thru.restore(np.zeros_like(scene.seen), scene.z)


def test_nothing_but_backscatter_is_refused(scene: HazyScene) -> None:
    open_water = np.array(VEIL) * (1.0 - np.exp(-np.array(BETA) * scene.z[..., None]))
    with pytest.raises(NotRestoredError, match="too little light"):
        sea_thru.restore(open_water.astype(np.float32), scene.z)


def test_too_few_dark_pixels_are_refused() -> None:
    with pytest.raises(NotRestoredError, match="too few dark pixels"):
        fit_backscatter(np.full((400, 3), 0.5), np.linspace(0.5, 2.0, 400))


@pytest.mark.parametrize("seed", range(4))
def test_any_pictures_and_ranges_give_pictures_or_a_reason(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pictures = (rng.random((2, 48, 64, 3)) ** rng.uniform(0.2, 8.0)).astype(np.float32)
    z = (10.0 ** rng.uniform(-6.0, 6.0, (2, 48, 64))).astype(np.float32)
    z[rng.random(z.shape) < 0.2] = [0.0, np.nan, np.inf, -1.0][seed]
    restored = np.zeros(1)
    with contextlib.suppress(NotRestoredError):
        restored = sea_thru.restore(pictures, z)
    assert ((restored >= 0.0) & (restored <= 1.0)).all()
