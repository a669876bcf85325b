"""Outliers and the ranges' loss: what they mean, and the kernels against their definitions."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.photometric import (
    MIN_RANGE,
    depth_loss,
    depth_loss_torch,
    outlier_mask,
    outlier_mask_torch,
)

SIZES = [(1, 1), (3, 40), (41, 67), (130, 70)]
"""The last has more pixels than are summed at a time."""


def maps(height: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Range, alpha, the prior's inverse range and weight."""
    random = torch.Generator().manual_seed(height)
    z, alpha, inverse_range, weight = torch.rand(4, height, width, generator=random)
    inverse_range[inverse_range < 0.3] = 0.0
    return 3.0 * z, alpha, 2.0 * inverse_range, weight


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("threads", [1, 3])
def test_the_kernel_of_ranges_agrees_with_float64_autograd(
    height: int, width: int, threads: int
) -> None:
    z, *constants = maps(height, width)
    exact = z.double().requires_grad_()
    wanted = depth_loss_torch(exact, *(values.double() for values in constants))
    wanted.backward()
    plain = z.clone().requires_grad_()
    got = depth_loss(plain, *constants, threads)
    torch.autograd.backward(3 * got)
    assert got.item() == pytest.approx(wanted.item(), rel=1e-5)
    assert plain.grad is not None
    assert exact.grad is not None
    torch.testing.assert_close(plain.grad.double(), 3 * exact.grad, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("threads", [1, 3])
def test_the_kernel_of_outliers_agrees_with_its_definition(
    height: int, width: int, threads: int
) -> None:
    random = torch.Generator().manual_seed(width)
    rendered, target = torch.rand(2, height, width, 3, generator=random)
    weight = torch.rand(height, width, generator=random)
    rendered[0, 0, 0] = torch.nan
    found = outlier_mask(rendered, target, weight, 0.2, threads)
    assert torch.equal(found, outlier_mask_torch(rendered, target, weight, 0.2))
    assert not found[0, 0]


def test_the_loss_of_ranges_is_the_same_on_one_and_on_three_threads() -> None:
    one, three = (depth_loss(*maps(130, 70), threads) for threads in (1, 3))
    assert torch.equal(one, three)


def test_planes_that_do_not_fit_are_refused() -> None:
    z, alpha, inverse_range, weight = maps(8, 8)
    with pytest.raises(AquaFlowError, match=r"shapes .*\(4, 8\)"):
        depth_loss(z, alpha, inverse_range, weight[:4])
    with pytest.raises(AquaFlowError, match=r"shapes .*\(4, 8\)"):
        outlier_mask(torch.rand(8, 8, 3), torch.rand(4, 8, 3), weight, 0.2)


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_one_channel_alone_makes_an_outlier(channel: int) -> None:
    target = torch.full((5, 6, 3), 0.5)
    rendered = target.clone()
    rendered[2, 3, channel] += 0.25
    rendered[1, 1, channel] -= 0.25
    M = outlier_mask(rendered, target, torch.ones(5, 6), tau_e=0.2)
    wrong = [(1, 1), (2, 3)]
    assert [tuple(where) for where in torch.nonzero(~M).tolist()] == wrong


def test_the_same_error_may_pass_in_the_corner_and_not_in_the_centre() -> None:
    target, K_rad = torch.zeros(31, 41, 3), torch.ones(31, 41)
    K_rad[0, 0] = 0.8
    M = outlier_mask(target + 0.22, target, K_rad, tau_e=0.2)
    assert not M[15, 20]
    assert M[0, 0]


def test_the_mask_hands_no_gradient_on() -> None:
    rendered = torch.rand(4, 4, 3, requires_grad=True)
    assert not outlier_mask(rendered, torch.zeros(4, 4, 3), torch.ones(4, 4), 0.2).requires_grad


def test_depth_counts_only_where_the_prior_knows_and_the_map_is_solid() -> None:
    z = torch.full((2, 2), 2.0, requires_grad=True)
    alpha = torch.tensor([[0.9, 0.9], [0.4, 0.4]])
    prior = torch.tensor([[0.75, 0.0], [0.75, 0.0]])
    loss = depth_loss(z, alpha, prior, torch.ones(2, 2))
    torch.autograd.backward(loss)
    assert float(loss.detach()) == pytest.approx(0.25 / 4)
    assert z.grad is not None
    assert torch.nonzero(z.grad).tolist() == [[0, 0]]
    assert z.grad[0, 0] > 0.0  # the prior says nearer


def test_depth_is_weighed_by_trust_and_does_not_move_alpha() -> None:
    z, prior = torch.full((1, 2), 2.0), torch.full((1, 2), 0.75)
    alpha = torch.full((1, 2), 0.9, requires_grad=True)
    loss = depth_loss(z, alpha, prior, torch.tensor([[0.5, 0.0]]))
    assert float(loss) == pytest.approx(0.5 * 0.25 / 2)
    assert not loss.requires_grad


def test_a_range_of_zero_makes_the_depth_loss_large_and_not_infinite() -> None:
    z = torch.zeros(1, 1, requires_grad=True)
    loss = depth_loss(z, torch.ones(1, 1), torch.ones(1, 1), torch.ones(1, 1))
    torch.autograd.backward(loss)
    assert float(loss.detach()) == pytest.approx(1.0 / MIN_RANGE - 1.0)
    assert z.grad is not None
    assert torch.isfinite(z.grad).all()
