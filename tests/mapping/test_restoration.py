"""Views without their water: what the picture says where the map knows how far, else the map."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aquaflow.config import MediumConfig
from aquaflow.mapping.restoration import (
    drawn_without_water,
    restored_picture,
    to_bytes,
)
from aquaflow.mapping.scene import RenderedMap, Scene
from aquaflow.render.views import View
from aquaflow.water.tone import ShownTone
from aquaflow.water.white_balance import WhiteBalance
from tests.mapping.mapping_scenes import floor, renderer, view_of

BRIGHTER_ABOVE = torch.tensor([0.1, -0.6, -0.1, 0.0, 0.2])


def submerged(uneven: bool = False) -> tuple[Scene, View]:
    """A floor in water, and its picture with a white sheet that the map knows nothing of."""
    scene = Scene(MediumConfig(), renderer(), torch.Generator().manual_seed(0))
    scene.gaussians = floor(columns=40, rows=30, scale=0.06)
    murk = [torch.tensor(v) for v in ((0.4, 0.2, 0.15), (0.1, 0.25, 0.3), (0.4, 0.3, 0.2))]
    scene.medium.set_water(*murk, BRIGHTER_ABOVE if uneven else None)
    seen = scene.show(view_of(np.zeros((48, 64, 3), np.uint8))).image
    image = to_bytes(seen.numpy())
    image[:8, :8] = 255
    return scene, view_of(image)


@pytest.mark.parametrize("uneven", [False, True])
def test_what_the_map_explains_is_restored_to_the_maps_radiance(uneven: bool) -> None:
    scene, view = submerged(uneven)
    shown = scene.show(view)
    restored = restored_picture(scene, view, shown).image
    solid = shown.alpha > 0.99
    solid[:8, :8] = False
    assert float((restored - shown.radiance)[solid].abs().max()) < 0.03
    # ... and it is the picture's: what the map lacks is there.
    assert float((restored - shown.radiance)[:8, :8].mean()) > 0.2


def test_uneven_backscatter_makes_one_side_of_the_picture_brighter() -> None:
    even, uneven = (submerged(uneven)[0] for uneven in (False, True))
    blank = view_of(np.zeros((48, 64, 3), np.uint8))
    ratio = uneven.show(blank).image.mean(dim=(1, 2)) / even.show(blank).image.mean(dim=(1, 2))
    assert ratio[0] > 1.1
    assert ratio[-1] < 0.95
    torch.testing.assert_close(uneven.show(blank).radiance, even.show(blank).radiance)


def test_the_maps_radiance_stands_in_where_the_vehicle_is() -> None:
    scene, view = submerged()
    shown = scene.show(view)
    mask = np.ones((48, 64), bool)
    mask[20:30] = False
    view.mask = mask
    restored = restored_picture(scene, view, shown).image
    solid = shown.alpha[20:30] > 0.99
    assert float((restored - shown.radiance)[20:30][solid].abs().max()) < 0.02


def test_what_was_not_mapped_stays_as_the_camera_saw_it() -> None:
    scene, view = submerged()
    shown = scene.show(view)
    shown.alpha[12:20], shown.radiance[12:20] = 0.0, 0.0
    restored = restored_picture(scene, view, shown).image
    torch.testing.assert_close(restored[12:20], view.target()[12:20])


def with_open_water(choice: str) -> tuple[Scene, View, RenderedMap]:
    """The floor, in a picture whose upper rows show open water, where the map has Gaussians."""
    scene, view = submerged()
    scene.config = scene.config.model_copy(update={"open_water": choice})
    scene.balance = WhiteBalance(1.0, (0.4, 0.4, 0.4), (1.0, 1.0, 1.0), 0.1)
    shown = scene.show(view)
    image = view.image.copy()
    image[:24] = np.rint(255.0 * scene.medium.B_inf_logit.sigmoid().detach().numpy())
    image[24:] = np.random.default_rng(0).integers(60, 200, (24, 64, 3))
    return scene, view_of(image), shown


def test_open_water_is_kept_as_the_camera_saw_it() -> None:
    scene, view, shown = with_open_water("kept")
    restored = restored_picture(scene, view, shown)
    torch.testing.assert_close(restored.image[:8], view.target()[:8], atol=1e-3, rtol=0.0)
    assert restored.opaque is None
    assert restored.picture_bytes(ShownTone()).shape == (48, 64, 3)


def test_open_water_is_black_unless_another_is_wished() -> None:
    assert MediumConfig().open_water == "black"
    restored = restored_picture(*with_open_water("black"))
    assert float(restored.image[:8].max()) < 1e-3
    assert float(restored.image[36:].mean()) > 0.1
    assert restored.opaque is None
    assert restored.picture_bytes(ShownTone()).shape == (48, 64, 3)


def test_before_the_first_fit_no_water_is_known_to_be_open() -> None:
    scene, view, shown = with_open_water("removed")
    scene.balance = None
    assert bool(restored_picture(scene, view, shown).opaque.all())


def test_open_water_begins_softly() -> None:
    restored = restored_picture(*with_open_water("black")).image.mean(dim=(1, 2))
    between = (restored > 0.1 * restored[-1]) & (restored < 0.8 * restored[-1])
    assert int(between.sum()) >= 3


def test_open_water_is_transparent_where_it_is_to_be_removed() -> None:
    restored = restored_picture(*with_open_water("removed"))
    picture = restored.picture_bytes(ShownTone())
    assert picture.shape == (48, 64, 4)
    assert not picture[:16].any()
    assert (picture[32:, :, 3] == 255).all()


def test_without_a_picture_what_the_map_has_not_is_transparent() -> None:
    scene, view, shown = with_open_water("removed")
    shown.alpha[:10] = 0.2
    picture = drawn_without_water(scene, view, shown).picture_bytes(ShownTone())
    np.testing.assert_array_equal(picture[..., 3] == 255, (shown.alpha > 0.5).numpy())
    assert not picture[:10].any()


def test_clear_water_has_no_open_water() -> None:
    scene, view, shown = with_open_water("removed")
    scene.medium.active = False
    assert bool(restored_picture(scene, view, shown).opaque.all())


@pytest.mark.parametrize("choice", ["kept", "removed", "black"])
def test_what_was_not_restored_from_the_picture_has_no_confidence(choice: str) -> None:
    scene, view, shown = with_open_water(choice)
    mask = np.ones((48, 64), bool)
    mask[20:30] = False
    view.mask = mask
    restored = restored_picture(scene, view, shown)
    assert not restored.confidence[:16].any()
    assert not restored.confidence[20:30].any()
    rest = restored.confidence[36:][shown.alpha[36:] > 0.5]
    assert float(rest.min()) > 0.3
    assert restored.confidence_bytes().dtype == np.uint8
    assert restored.confidence_bytes().shape == (48, 64)
    assert restored.amplification is not None
    assert restored.amplification.shape == (2, 3)
    assert bool((restored.amplification[0] <= restored.amplification[1]).all())


def test_before_the_first_fit_a_pixel_is_believed_or_not_and_nothing_is_amplified() -> None:
    scene, view = submerged()
    restored = restored_picture(scene, view, scene.show(view))
    assert set(restored.confidence.unique().tolist()) <= {0.0, 1.0}
    assert restored.amplification is None


def test_a_picture_of_nothing_but_open_water_has_no_amplification() -> None:
    scene, view, shown = with_open_water("kept")
    scene.balance = WhiteBalance(1.0, (0.4, 0.4, 0.4), (0.8, 0.9, 1.0), 0.1)
    shown.alpha[:] = 0.0
    assert restored_picture(scene, view, shown).amplification is None


def test_the_map_s_own_radiance_is_restored_from_no_picture() -> None:
    scene, view = submerged()
    shown = scene.show(view)
    drawn = drawn_without_water(scene, view, shown)
    torch.testing.assert_close(drawn.image, shown.radiance)
    assert not drawn.confidence.any()
    assert drawn.opaque is None


def test_bytes_are_rounded_and_kept_in_range() -> None:
    image = np.array([[[-1.0, 0.5, 2.0]]])
    assert to_bytes(image).tolist() == [[[0, 128, 255]]]
