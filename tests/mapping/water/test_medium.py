"""The learnable medium: always physical, isotropic to begin with, and able to learn."""

from __future__ import annotations

import pytest
import torch

from aquaflow.config import MediumConfig
from aquaflow.mapping.water.medium import Medium, inverse_softplus
from tests.mapping.mapping_scenes import pose

AHEAD, DOWN = torch.eye(3), torch.from_numpy(pose((0, 0, 0), (1.3, 0, 0)).R).float()


def medium(**keys: float) -> Medium:
    return Medium(MediumConfig.model_validate(keys), torch.Generator().manual_seed(0))


@pytest.mark.parametrize("raw", [-100.0, 100.0, None])
def test_wild_parameters_still_make_water(raw: float | None) -> None:
    wild, rng = medium(), torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in wild.parameters():
            if raw is None:
                parameter.uniform_(-100.0, 100.0, generator=rng)
            else:
                parameter.fill_(raw)
    seen = wild(DOWN)
    for rate in (seen.beta_a, seen.b, seen.d):
        assert torch.isfinite(rate).all()
        assert (rate >= 0.0).all()
    for colour in (seen.B_inf, seen.B_res):
        assert ((colour >= 0.0) & (colour <= 1.0)).all()


def test_it_starts_as_the_config_says_whichever_way_the_camera_looks() -> None:
    start = medium(
        initial_attenuation=0.17,
        initial_B_inf=0.4,
        initial_B_res=0.02,
        initial_residual_decay=1.5,
    )
    wanted = (0.17, 0.4, 0.17, 0.02, 1.5)
    for R in (AHEAD, DOWN):
        seen = start(R).stacked()
        torch.testing.assert_close(seen, torch.tensor(wanted)[:, None].expand(5, 3))


def test_it_learns_that_attenuation_depends_on_orientation() -> None:
    learning = medium()
    optimiser = torch.optim.Adam(learning.parameters(), lr=5e-3)
    for _ in range(120):
        optimiser.zero_grad()
        loss = (learning(AHEAD).beta_a - 0.1).square().sum()
        loss = loss + (learning(DOWN).beta_a - 0.3).square().sum()
        torch.autograd.backward(loss)
        optimiser.step()
    torch.testing.assert_close(learning(AHEAD).beta_a, torch.full((3,), 0.1), atol=0.02, rtol=0.0)
    torch.testing.assert_close(learning(DOWN).beta_a, torch.full((3,), 0.3), atol=0.02, rtol=0.0)


def test_every_parameter_gets_a_gradient_once_the_output_layer_has_moved() -> None:
    learning = medium()
    with torch.no_grad():
        learning.output.weight.fill_(0.01)
    torch.autograd.backward(learning(DOWN).stacked().square().sum())
    for name, parameter in learning.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0.0, name


def test_water_that_is_set_comes_back_in_every_direction() -> None:
    beta_a, B_inf, b = torch.tensor([[0.6, 0.2, 0.01], [0.1, 0.4, 0.9], [2.0, 0.3, 5.0]])
    told = medium()
    before = told(AHEAD)
    with torch.no_grad():
        told.output.weight.fill_(0.5)
    told.set_water(beta_a, B_inf, b)
    for R in (AHEAD, DOWN):
        seen = told(R)
        torch.testing.assert_close(seen.beta_a, beta_a, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(seen.B_inf, B_inf)
        torch.testing.assert_close(seen.b, b, rtol=1e-4, atol=1e-6)
        assert torch.equal(seen.B_res, before.B_res)
        assert torch.equal(seen.d, before.d)


def test_water_at_the_limits_is_set_just_inside_them() -> None:
    told = medium()
    told.set_water(torch.zeros(3), torch.tensor([0.0, 0.5, 1.0]), torch.zeros(3))
    seen = told(AHEAD)
    assert all(torch.isfinite(parameter).all() for parameter in told.parameters())
    torch.testing.assert_close(seen.beta_a, torch.full((3,), 1e-4), rtol=1e-2, atol=0.0)
    torch.testing.assert_close(seen.B_inf, torch.tensor([0.01, 0.5, 0.99]))


def test_inverse_softplus_is_finite_at_both_ends() -> None:
    y = torch.tensor([0.0, 1e-4, 1.0, 1e3])
    x = inverse_softplus(y)
    assert torch.isfinite(x).all()
    torch.testing.assert_close(
        torch.nn.functional.softplus(x), y.clamp_min(1e-4), rtol=1e-2, atol=0.0
    )
