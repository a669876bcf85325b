"""The water taken out of a picture again."""

from __future__ import annotations

import pytest
import torch

from aquaflow.render.water import compose_water
from aquaflow.water.medium import MAX_RESTORED, MIN_TRANSMISSION, WaterParameters
from tests.mapping.mapping_scenes import water


def scene(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Radiance [20, 30, 3] in [0, 1] and range [20, 30] from 0.1 to 12."""
    rng = torch.Generator().manual_seed(seed)
    return torch.rand(20, 30, 3, generator=rng), 0.1 + 11.9 * torch.rand(20, 30, generator=rng)


@pytest.mark.parametrize("beta", [0.05, 0.2, 0.6])
def test_restoring_inverts_the_renderers_water_where_light_still_arrives(beta: float) -> None:
    J, z = scene()
    murk = water(beta)
    image, _ = compose_water(torch.cat([J, z[..., None]], -1), torch.ones_like(z), murk.stack())
    restored, recoverable = murk.restore(image, z)
    assert recoverable.any()
    torch.testing.assert_close(restored[recoverable], J[recoverable], atol=1e-4, rtol=0.0)


def test_pixels_behind_too_much_water_are_flagged_in_any_channel() -> None:
    _, z = scene()
    murk = water(0.4)
    _, recoverable = murk.restore(torch.full((20, 30, 3), 0.5), z)
    weakest = torch.exp(-murk.beta_a.max() * z)
    assert torch.equal(recoverable, weakest > MIN_TRANSMISSION)
    assert recoverable.any()
    assert not recoverable.all()


def test_thick_water_far_away_overflows_nothing() -> None:
    thick = WaterParameters(*(torch.full((3,), value) for value in (50.0, 0.3, 50.0, 0.1, 50.0)))
    z = torch.full((4, 5), 1e3, requires_grad=True)
    restored, recoverable = thick.restore(torch.rand(4, 5, 3), z)
    restored.sum().backward()
    assert torch.isfinite(restored).all()
    assert z.grad is not None
    assert torch.isfinite(z.grad).all()
    assert not recoverable.any()
    far = thick.backscatter(z.detach())
    torch.testing.assert_close(far, torch.full((4, 5, 3), 0.3), atol=1e-3, rtol=0.0)


def test_a_range_below_zero_counts_as_no_water() -> None:
    murk = water()
    behind, nothing = torch.full((2, 2), -30.0), torch.zeros(2, 2)
    assert torch.equal(murk.transmission(behind), torch.ones(2, 2, 3))
    assert torch.equal(murk.backscatter(behind), murk.backscatter(nothing))


def test_restored_radiance_stays_between_black_and_the_cap() -> None:
    clear_far = WaterParameters(*(torch.full((3,), value) for value in (1.0, 0.0, 1.0, 0.0, 1.0)))
    bright, _ = clear_far.restore(torch.ones(2, 2, 3), torch.full((2, 2), 2.5))
    assert torch.equal(bright, torch.full((2, 2, 3), MAX_RESTORED))
    dark, _ = water(B_inf=0.5).restore(torch.zeros(2, 2, 3), torch.full((2, 2), 2.5))
    assert torch.equal(dark, torch.zeros(2, 2, 3))


def test_backscatter_goes_from_the_residual_to_the_colour_of_open_water() -> None:
    murk = water()
    near, far = murk.backscatter(torch.tensor([0.0, 1e4]))
    torch.testing.assert_close(near, murk.B_res)
    torch.testing.assert_close(far, murk.B_inf, atol=1e-3, rtol=0.0)
