"""The fused image formation against its readable torch definition."""

from __future__ import annotations

import pytest
import torch

from aquaflow.render.water import compose_water, compose_water_torch

GAINS = {"even": (False, False), "uneven": (True, False), "both gains": (True, True)}


def random_gains(seed: int, which: str) -> list[torch.Tensor | None]:
    """Of the backscatter and of the camera, where ``which`` has them."""
    random = torch.Generator().manual_seed(200 + seed)
    gains = [0.5 + torch.rand(37, 41, generator=random) for _ in range(2)]
    return [gain if there else None for gain, there in zip(gains, GAINS[which], strict=True)]


def random_scene(seed: int) -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    alpha = torch.rand(37, 41, generator=random)
    alpha[:5] = 0.0
    radiance = torch.rand(37, 41, 3, generator=random) * alpha[..., None]
    z = 0.2 + 6.0 * torch.rand(37, 41, generator=random)
    drawn = torch.cat([radiance, (z * alpha)[..., None]], dim=-1)
    water = 0.05 + torch.rand(5, 3, generator=random)
    return [drawn, alpha, water]


@pytest.mark.parametrize("which", GAINS)
@pytest.mark.parametrize("seed", range(3))
def test_fused_water_matches_its_definition(seed: int, which: str) -> None:
    inputs, (uneven, gain) = random_scene(seed), random_gains(seed, which)
    image, z = compose_water(*inputs, uneven=uneven, gain=gain)
    wide = [None if plane is None else plane.double() for plane in (uneven, gain)]
    wanted, wanted_z = compose_water_torch(*(tensor.double() for tensor in inputs), *wide)
    assert torch.allclose(image.double(), wanted, atol=2e-6)
    assert torch.allclose(z.double(), wanted_z, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("which", GAINS)
@pytest.mark.parametrize("seed", range(3))
def test_gradients_of_fused_water_match_autograd(seed: int, which: str) -> None:
    uneven, gain = random_gains(seed, which)
    random = torch.Generator().manual_seed(100 + seed)
    g_image = torch.randn(37, 41, 3, generator=random)
    g_z = torch.randn(37, 41, generator=random)
    gradients = []
    for function, dtype in ((compose_water, torch.float32), (compose_water_torch, torch.float64)):
        leaves = [tensor.to(dtype).requires_grad_() for tensor in random_scene(seed)]
        image, z = function(*leaves, uneven=uneven, gain=gain)
        loss = (image * g_image.to(dtype)).sum() + (z * g_z.to(dtype)).sum()
        gradients.append(torch.autograd.grad(loss, leaves))
    for fused, wanted in zip(*gradients, strict=True):
        assert float((fused.double() - wanted).norm() / wanted.norm()) < 1e-5


def test_opaque_water_and_empty_map_stay_finite() -> None:
    drawn = torch.zeros(4, 4, 4)
    drawn[..., 3] = 1e6
    water = torch.full((5, 3), 50.0).requires_grad_()
    image, z = compose_water(drawn, torch.zeros(4, 4), water)
    (image.sum() + z.sum()).backward()
    assert torch.isfinite(image).all()
    assert water.grad is not None
    assert torch.isfinite(water.grad).all()


def test_water_is_the_same_on_one_and_on_two_threads() -> None:
    inputs = random_scene(7)
    one, _ = compose_water(*inputs, threads=1)
    two, _ = compose_water(*inputs, threads=2)
    assert torch.equal(one, two)
