"""Water from air to ink, range from 1 cm to 1 km: formation, inversion, gradient."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from aquaflow.config import MediumConfig
from aquaflow.lab.stress.case import Check, case
from aquaflow.mapping.gaussians import raw_colour
from aquaflow.render.contract import radiance
from aquaflow.render.photometric import depth_loss
from aquaflow.render.water import compose_water, compose_water_torch
from aquaflow.water.medium import LearnedMedium, WaterParameters

RATES = (0.0, 1e-8, 0.01, 0.5, 5.0, 50.0)
"""1/m"""
RANGES_M = (0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)
"""A centimetre to a kilometre: further than a camera sees in any water."""
LARGEST_ATTENUATION = 3.0e3
"""exp(8): what the clamped optical depth allows."""


def _water(beta: float, B_inf: float = 0.3) -> WaterParameters:
    rate = torch.full((3,), beta, requires_grad=True)
    return WaterParameters(
        rate, torch.full((3,), B_inf), rate, torch.full((3,), 0.01), torch.full((3,), 1.0)
    )


def _ranges() -> Tensor:
    """[1, 6] m"""
    return torch.tensor(RANGES_M)[None]


@case("water", "water.medium.MAX_OPTICAL_DEPTH")
def attenuation_0_to_50(check: Check, seed: int) -> None:
    """beta from 0 to 50 1/m over 1 cm to 1 km: transmission is never 0, its inverse never wild."""
    for beta in RATES:
        water, z = _water(beta), _ranges()
        transmission = water.transmission(z)
        backscatter = water.backscatter(z)
        check.finite(f"formation at beta {beta}", transmission, backscatter)
        check.below(
            "1 / transmission", float(1.0 / transmission.detach().min()), LARGEST_ATTENUATION
        )
        (gradient,) = torch.autograd.grad((transmission + backscatter).sum(), water.beta_a)
        check.finite(f"gradient at beta {beta}", gradient)


@case("water", "water.medium.MAX_OPTICAL_DEPTH")
def range_1_cm_to_1_km(check: Check, seed: int) -> None:
    """Ranges behind the camera, at 0 and beyond 1 km are no more transparent than clear water."""
    z = torch.tensor([[-1e3, -1.0, 0.0, *RANGES_M, 1e9]])
    for beta in RATES:
        transmission = _water(beta).transmission(z)
        check.finite("transmission", transmission)
        check.below("transmission", float(transmission.detach().max()), 1.0)


@case("water", "water.medium.MIN_TRANSMISSION")
def transmission_to_0(check: Check, seed: int) -> None:
    """Where no light arrives nothing is restored, and the mask is False."""
    image = torch.rand(1, len(RANGES_M), 3, generator=torch.Generator().manual_seed(seed))
    restored, recoverable = _water(5.0).restore(image, _ranges())
    check.finite("restored", restored)
    check.below("restored radiance", float(restored.detach().max()), 2.0)
    dark = _ranges()[0] > 0.99
    check.true("dark pixels are not recoverable", not bool(recoverable[0][dark].any()))
    check.true("near pixels are recoverable", bool(recoverable[0][0]))


@case("water", "water.medium.B_INF_RANGE")
def B_inf_at_0_and_1(check: Check, seed: int) -> None:
    """Water that scatters nothing, and water that is white: the learnable medium takes both."""
    for B_inf in (0.0, 1.0):
        medium = LearnedMedium(MediumConfig(), torch.Generator().manual_seed(seed))
        medium.set_water(torch.full((3,), 0.5), torch.full((3,), B_inf), torch.full((3,), 0.5))
        _medium_is_sound(check, medium)
        check.below("error of B_inf", _off(medium(torch.eye(3)).B_inf, B_inf), 0.02)


@case("water", "water.medium.MIN_RATE")
def rates_at_0_and_50(check: Check, seed: int) -> None:
    """The learnable medium starts from clear water and from ink."""
    for rate in (0.0, 50.0):
        medium = LearnedMedium(MediumConfig(), torch.Generator().manual_seed(seed))
        medium.set_water(torch.full((3,), rate), torch.full((3,), 0.3), torch.full((3,), rate))
        _medium_is_sound(check, medium)
        check.below("error of beta_a", _off(medium(torch.eye(3)).beta_a, rate), 1e-3)


@case("water", "mapping.gaussians.MIN_RADIANCE")
def black_and_glowing_radiance(check: Check, seed: int) -> None:
    """Radiance 0 and 100 become raw colours and back."""
    for value in (0.0, 1e-30, 1e-3, 1.0, 100.0):
        raw = raw_colour(torch.full((1, 3), value)).requires_grad_()
        back = radiance(raw)
        (gradient,) = torch.autograd.grad(back.sum(), raw)
        check.finite(f"raw colour of {value}", raw, back, gradient)
        check.below("error of the radiance", abs(float(back[0, 0].detach()) - value), 1.1e-3)


@case("water", "render.water.MIN_SOLID")
def picture_through_bare_map(check: Check, seed: int) -> None:
    """Pixels where nothing was drawn see B_inf, in the kernel and in torch."""
    alpha = torch.tensor([[0.0, 1e-30, 1e-6, 0.5, 1.0]])
    for beta in RATES:
        for compose in (compose_water, compose_water_torch):
            leaves = [
                torch.cat([0.3 * alpha[..., None].expand(1, 5, 3), 2.0 * alpha[..., None]], -1),
                alpha,
                torch.tensor([[beta] * 3, [0.3] * 3, [beta] * 3, [0.01] * 3, [1.0] * 3]),
            ]
            leaves = [leaf.clone().requires_grad_() for leaf in leaves]
            image, z = compose(leaves[0], leaves[1], leaves[2])
            gradients = torch.autograd.grad((image.sum() + z.sum()), leaves)
            check.finite(f"{compose.__name__} at beta {beta}", image, z, *gradients)
            check.below(
                "error of open water", float((image[0, 0].detach() - 0.3).abs().max()), 1e-6
            )


@case("water", "render.photometric.MIN_RANGE")
def depth_loss_at_range_0(check: Check, seed: int) -> None:
    """Pixels of range 0, drawn and not drawn, known and not known."""
    z = torch.tensor([[0.0, 0.0, 0.0, 1e-30, 1e9]], requires_grad=True)
    alpha = torch.tensor([[0.0, 1.0, 1.0, 1.0, 1.0]])
    known = torch.tensor([[0.0, 0.0, 2.0, 2.0, 2.0]])
    loss = depth_loss(z, alpha, known, torch.ones(1, 5))
    (gradient,) = torch.autograd.grad(loss, z)
    check.finite("loss and gradient", loss, gradient)
    check.below("loss", float(loss.detach()), 1e3)


def _off(
    values: Tensor,  # [3]
    wanted: float,
) -> float:
    """Largest error of learnable values."""
    return float((values.detach() - wanted).abs().max())


def _medium_is_sound(check: Check, medium: LearnedMedium) -> None:
    water = medium(torch.eye(3))
    total = water.transmission(_ranges()).sum() + water.backscatter(_ranges()).sum()
    total.backward()  # type: ignore[no-untyped-call]
    check.finite("medium", water.stack(), total)
    for name, parameter in medium.named_parameters():
        check.finite(f"medium {name}", parameter, parameter.grad)
    check.true("rates are positive", math.isfinite(float(water.beta_a.detach().log().sum())))
