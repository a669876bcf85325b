"""Raw parameters to what is drawn: the kernel against its definition, and that by differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aquaflow.render.contract import COLOUR_SHARPNESS, activate, activate_torch, radiance
from aquaflow.render.library import library_or_none

CENTRE = torch.tensor([0.3, -0.2, 0.1])


def raw(count: int, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """Means, log-scales, opacity logits and raw colours over everything that maps hold."""
    draw = torch.Generator().manual_seed(count)

    def between(low: float, high: float, width: int) -> Tensor:
        drawn = torch.rand(count, width, generator=draw, dtype=dtype)
        return (low + (high - low) * drawn).requires_grad_()

    return [between(-5, 5, 3), between(-12, 3, 3), between(-15, 15, 1), between(-3, 4, 3)]


def gradients(function: object, inputs: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """What ``function`` gives, and the gradients of a weighted sum of it."""
    outputs = function(*inputs, CENTRE.to(inputs[0].dtype))  # type: ignore[operator]
    draw = torch.Generator().manual_seed(1)
    total = sum(
        (torch.rand(each.shape, generator=draw).to(each.dtype) * each).sum() for each in outputs
    )
    found = torch.autograd.grad(total, inputs)
    return [each.detach() for each in outputs], list(found)


@pytest.mark.parametrize("count", [1, 63, 64, 65, 1000])
def test_the_kernel_gives_what_the_definition_gives_in_float64(count: int) -> None:
    assert library_or_none() is not None, "no kernels here: nothing was compared"
    drawn, slopes = gradients(activate, raw(count))
    double = [each.detach().double().requires_grad_() for each in raw(count)]
    wanted, wanted_slopes = gradients(activate_torch, double)
    for found, true in zip(drawn + slopes, wanted + wanted_slopes, strict=True):
        torch.testing.assert_close(found.double(), true, rtol=3e-6, atol=1e-9)


def test_the_definition_has_the_gradients_of_finite_differences() -> None:
    inputs = raw(4, torch.float64)
    assert torch.autograd.gradcheck(
        lambda *each: tuple(activate_torch(*each, CENTRE.double())), inputs
    )


def test_parameters_beyond_all_bounds_stay_finite() -> None:
    far = torch.tensor([[1e4, -1e4, 80.0]])
    scales, opacities, colours = activate(far, far.clamp(-80, 80), far[:, :1], far, CENTRE)
    for drawn in (scales, opacities, colours):
        assert torch.isfinite(drawn).all()
        assert (drawn >= 0.0).all()


def test_a_gaussian_in_the_camera_has_no_gradient_of_its_range() -> None:
    means = CENTRE[None].clone().requires_grad_()
    rest = [torch.zeros(1, width) for width in (3, 1, 3)]
    _, _, colours = activate(means, *rest, CENTRE)
    (slope,) = torch.autograd.grad(colours[0, 3], means)
    assert (slope == 0.0).all()


def test_threads_change_no_bit() -> None:
    one, four = (activate(*raw(500), CENTRE, threads=threads) for threads in (1, 4))
    assert all(torch.equal(a, b) for a, b in zip(one, four, strict=True))


def test_no_gaussians_are_drawn_as_none() -> None:
    scales, opacities, colours = activate(*raw(0), CENTRE)
    assert (scales.shape, opacities.shape, colours.shape) == ((0, 3), (0,), (0, 4))


def test_bright_radiance_is_its_raw_colour() -> None:
    assert float(radiance(torch.tensor(0.9))) == pytest.approx(0.9, abs=1e-4)
    assert float(radiance(torch.tensor(0.0))) == pytest.approx(0.6931 / COLOUR_SHARPNESS, abs=1e-4)
