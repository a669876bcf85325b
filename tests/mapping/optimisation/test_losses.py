"""The loss terms beside L1 and SSIM."""

from __future__ import annotations

import pytest
import torch

from aquaflow.mapping.optimisation.losses import (
    MIN_RANGE,
    depth_loss,
    outlier_mask,
    radial_weight,
    scale_loss,
)


def test_the_radial_weight_falls_from_one_to_082_in_the_corners() -> None:
    K = radial_weight(31, 41)
    assert K.shape == (31, 41)
    assert K.is_contiguous()
    assert float(K[15, 20]) == 1.0
    for corner in (K[0, 0], K[0, -1], K[-1, 0], K[-1, -1]):
        assert float(corner) == pytest.approx(0.8187, abs=1e-3)
    assert float(K.min()) == float(K[0, 0])


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
    target = torch.zeros(31, 41, 3)
    M = outlier_mask(target + 0.22, target, radial_weight(31, 41), tau_e=0.2)
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


def test_the_scale_loss_is_the_mean_volume_and_its_gradient_shrinks() -> None:
    scales = torch.tensor([[0.1, 0.2, 0.3], [1.0, 1.0, 2.0]]).log().requires_grad_()
    loss = scale_loss(scales)
    torch.autograd.backward(loss)
    assert float(loss.detach()) == pytest.approx((0.006 + 2.0) / 2)
    assert scales.grad is not None
    assert (scales.grad > 0.0).all()
