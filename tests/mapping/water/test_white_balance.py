"""Restored pictures: near things keep their colours, and nothing is amplified beyond reason."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from aquaflow.mapping.water.image_formation import Water
from aquaflow.mapping.water.white_balance import WhiteBalance

WATER = Water(
    torch.tensor([0.8, 0.3, 0.2]),
    torch.tensor([0.05, 0.3, 0.4]),
    torch.tensor([0.8, 0.4, 0.3]),
    torch.full((3,), 0.01),
    torch.ones(3),
)
BALANCE = WhiteBalance(near_range=0.5, mean=(0.3, 0.3, 0.3), attenuation_sigma=0.1)


def seen(J: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    return J * WATER.transmission(z) + WATER.backscatter(z)


def test_what_is_nearest_keeps_the_camera_s_colours_but_for_the_veil() -> None:
    J, z = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0)), torch.full((4, 5), 0.5)
    image = seen(J, z)
    restored = BALANCE.recover(image, z, WATER)
    torch.testing.assert_close(restored, image - WATER.backscatter(z), atol=0.03, rtol=0.0)


def test_grey_things_stay_grey_at_any_range_that_light_comes_from() -> None:
    z = torch.linspace(0.5, 2.5, 40).reshape(4, 10)
    J = 0.4 / BALANCE.gain(WATER) * torch.ones(4, 10, 3)  # grey in the near white balance
    restored = BALANCE.recover(seen(J, z), z, WATER)
    assert float((restored - restored.mean(dim=-1, keepdim=True)).abs().max()) < 0.06


def test_where_no_light_comes_back_the_scene_s_mean_stands_in() -> None:
    z = torch.full((2, 2), 50.0)
    restored = BALANCE.recover(WATER.B_inf.expand(2, 2, 3), z, WATER)
    expected = torch.tensor(BALANCE.mean) * BALANCE.gain(WATER)
    torch.testing.assert_close(restored, expected.expand(2, 2, 3), atol=0.02, rtol=0.0)


def test_a_channel_without_light_follows_the_others() -> None:
    water = replace(WATER, beta_a=torch.tensor([9.0, 0.1, 0.1]))
    z = torch.full((1, 2), 2.0)
    J = torch.tensor([[[0.1, 0.1, 0.1], [0.6, 0.6, 0.6]]])
    image = J * water.transmission(z) + water.backscatter(z)
    balance = WhiteBalance(near_range=0.0, mean=(0.3, 0.3, 0.3), attenuation_sigma=0.0)
    restored = balance.recover(image, z, water)
    assert float(restored[0, 1, 0]) > float(restored[0, 0, 0]) + 0.2


@pytest.mark.parametrize("bad", [0.0, 1e9])
def test_any_range_gives_a_picture(bad: float) -> None:
    z = torch.full((2, 2), bad)
    restored = BALANCE.recover(torch.full((2, 2, 3), 0.9), z, WATER)
    assert bool(torch.isfinite(restored).all())
    assert float(restored.min()) >= 0.0
