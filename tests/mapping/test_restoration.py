"""Views without their water: what the picture says where the map knows how far, else the map."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aquaflow.config import MediumConfig
from aquaflow.mapping.restoration import common_exposure, restored_picture, to_bytes
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.views import View
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
    restored = restored_picture(scene, view, shown)
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


def test_the_map_stands_in_where_range_or_scene_are_missing() -> None:
    scene, view = submerged()
    scene.config = scene.config.model_copy(update={"open_water": "black"})
    shown = scene.show(view)
    shown.alpha[:10] = 0.2
    mask = np.ones((48, 64), bool)
    mask[20:30] = False
    view.mask = mask
    restored = restored_picture(scene, view, shown)
    for rows in (slice(0, 10), slice(20, 30)):
        assert torch.equal(restored[rows], shown.radiance[rows])


def test_open_water_stays_as_the_camera_saw_it_unless_it_is_to_be_black() -> None:
    scene, view = submerged()
    shown = scene.show(view)
    shown.alpha[:10], shown.radiance[:10] = 0.0, 0.0
    torch.testing.assert_close(restored_picture(scene, view, shown)[:10], view.target()[:10])
    scene.config = scene.config.model_copy(update={"open_water": "black"})
    assert not restored_picture(scene, view, shown)[:10].any()


def test_the_brightest_of_all_pictures_sets_the_exposure_of_all() -> None:
    dark, bright = torch.full((4, 4, 3), 0.3), torch.full((4, 4, 3), 1.9)
    assert common_exposure([dark]) == 1.0
    assert common_exposure([dark, bright]) == pytest.approx(0.5)
    assert common_exposure([]) == 1.0


def test_bytes_are_rounded_and_kept_in_range() -> None:
    image = np.array([[[-1.0, 0.5, 2.0]]])
    assert to_bytes(image).tolist() == [[[0, 128, 255]]]
