"""The learnable medium: always physical, isotropic to begin with, and able to learn."""

from __future__ import annotations

import pytest
import torch

from aquaflow.config import MediumConfig
from aquaflow.water.medium import MAX_LOG_FACTOR, LearnedMedium, inverse_softplus
from tests.mapping.mapping_scenes import pose

AHEAD, DOWN = torch.eye(3), torch.from_numpy(pose((0, 0, 0), (1.3, 0, 0)).R).float()


def medium(**keys: float | bool) -> LearnedMedium:
    return LearnedMedium(MediumConfig.model_validate(keys), torch.Generator().manual_seed(0))


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
        seen = start(R).stack()
        torch.testing.assert_close(seen, torch.tensor(wanted)[:, None].expand(5, 3))


def test_it_learns_that_attenuation_depends_on_orientation() -> None:
    learning = medium(directional=True)
    optimiser = torch.optim.Adam(learning.parameters(), lr=5e-3)
    for _ in range(120):
        optimiser.zero_grad()
        loss = (learning(AHEAD).beta_a - 0.1).square().sum()
        loss = loss + (learning(DOWN).beta_a - 0.3).square().sum()
        torch.autograd.backward(loss)
        optimiser.step()
    torch.testing.assert_close(learning(AHEAD).beta_a, torch.full((3,), 0.1), atol=0.02, rtol=0.0)
    torch.testing.assert_close(learning(DOWN).beta_a, torch.full((3,), 0.3), atol=0.02, rtol=0.0)


def test_isotropic_water_never_depends_on_orientation() -> None:
    still = medium()
    with torch.no_grad():
        still.output.weight.fill_(0.5)
    both = still(torch.stack([AHEAD, DOWN])).beta_a
    assert torch.equal(both[0], both[1])
    assert torch.equal(both[0], still(AHEAD).beta_a)
    torch.autograd.backward(both.sum())
    assert still.output.weight.grad is None


def test_centred_the_factor_has_a_mean_of_one_over_the_dive() -> None:
    turning = medium(directional=True)
    with torch.no_grad():
        turning.output.weight.fill_(0.05)
    views = torch.stack([AHEAD, DOWN])
    mean = turning(views).beta_a.log().mean(dim=0)
    turning.centre(views)
    both = turning(views).beta_a.log()
    isotropic = torch.full((3,), MediumConfig().initial_attenuation).log()
    torch.testing.assert_close(both.mean(dim=0), isotropic, rtol=0.0, atol=1e-3)
    assert (mean - isotropic).abs().max() > 1e-2
    assert (both[0] - both[1]).abs().max() > 1e-2


def test_the_factor_stays_within_its_limit() -> None:
    wild = medium(directional=True)
    with torch.no_grad():
        wild.output.weight.fill_(100.0)
    for R in (AHEAD, DOWN):
        log_factor = (wild(R).beta_a / MediumConfig().initial_attenuation).log()
        assert log_factor.abs().max() <= MAX_LOG_FACTOR + 1e-5


def test_each_part_of_the_medium_learns_at_its_own_rate() -> None:
    config = MediumConfig(rate=1e-4, directional_rate=1e-2, directional=True)
    learning = LearnedMedium(config, torch.Generator().manual_seed(0))
    groups = learning.learned_at(config)
    rates = {id(p): group["lr"] for group in groups for p in group["params"]}
    assert rates == {
        id(p): 1e-2 if name in ("hidden.weight", "hidden.bias", "output.weight") else 1e-4
        for name, p in learning.named_parameters()
    }


def test_every_parameter_gets_a_gradient_once_the_output_layer_has_moved() -> None:
    learning = medium(directional=True)
    with torch.no_grad():
        learning.output.weight.fill_(0.01)
    torch.autograd.backward(learning(DOWN).stack().square().sum())
    for name, parameter in learning.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0.0, name


@pytest.mark.parametrize("directional", [False, True])
def test_water_that_is_set_comes_back_from_every_orientation(directional: bool) -> None:
    beta_a, B_inf, b = torch.tensor([[0.6, 0.2, 0.01], [0.1, 0.4, 0.9], [2.0, 0.3, 5.0]])
    told = medium(directional=directional)
    before = told(AHEAD)
    with torch.no_grad():
        told.output.weight.fill_(0.02)
    told.set_water(beta_a, B_inf, b)
    told.centre(torch.stack([AHEAD, DOWN]))
    mean = told(torch.stack([AHEAD, DOWN])).beta_a.log().mean(dim=0).exp()
    torch.testing.assert_close(mean, beta_a, rtol=1e-3, atol=1e-6)
    for R in (AHEAD, DOWN):
        seen = told(R)
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
