"""Tiles, bricks and nets: periodic, alike from cell to cell, and on flat floors."""

from __future__ import annotations

import pytest
import torch

from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.scene import (
    FLATTENED,
    Detail,
    random_scenes,
    regular_albedo,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def test_albedo_is_a_colour_and_has_no_seam() -> None:
    albedo = regular_albedo(Draw(1), 6, 128)
    assert albedo.shape == (6, 3, 128, 128)
    assert float(albedo.min()) >= 0.01
    assert float(albedo.max()) <= 1.0
    inner = (albedo[..., 1:] - albedo[..., :-1]).abs().mean(dim=(1, 2)).amax(1)
    seam = (albedo[..., 0] - albedo[..., -1]).abs().mean(dim=(1, 2))
    assert bool((seam <= 1.5 * inner).all())


def test_cells_are_more_alike_than_growth_would_be() -> None:
    grey = regular_albedo(Draw(2), 8, 128).mean(1)
    spectrum = torch.fft.rfft2(grey - grey.mean(dim=(1, 2), keepdim=True)).abs().square()
    share = spectrum.flatten(1).amax(1) / spectrum.flatten(1).sum(1)
    assert float(share.median()) > 0.03


def test_a_laid_floor_is_flat() -> None:
    detail = Detail(terrain=64, texture=128)
    rough = random_scenes(Draw(3), 4, detail)
    laid = random_scenes(Draw(3), 4, Detail(64, 128, regular=1.0))
    assert torch.allclose(laid.terrain.field, FLATTENED * rough.terrain.field)
    assert not torch.equal(laid.materials.picture, rough.materials.picture)


def test_scenes_without_regular_floors_are_what_they_always_were() -> None:
    plain = random_scenes(Draw(4), 2, Detail(64, 128))
    again = random_scenes(Draw(4), 2, Detail(64, 128, regular=0.0))
    assert torch.equal(plain.materials.picture, again.materials.picture)
