"""K_rad, and the term of the scales."""

from __future__ import annotations

import pytest
import torch

from aquaflow.mapping.optimisation import radial_weight, scale_loss


def test_the_radial_weight_falls_from_one_to_082_in_the_corners() -> None:
    K = radial_weight(31, 41)
    assert K.shape == (31, 41)
    assert K.is_contiguous()
    assert float(K[15, 20]) == 1.0
    for corner in (K[0, 0], K[0, -1], K[-1, 0], K[-1, -1]):
        assert float(corner) == pytest.approx(0.8187, abs=1e-3)
    assert float(K.min()) == float(K[0, 0])


def test_the_scale_loss_is_the_mean_volume_and_its_gradient_shrinks() -> None:
    scales = torch.tensor([[0.1, 0.2, 0.3], [1.0, 1.0, 2.0]]).log().requires_grad_()
    loss = scale_loss(scales)
    torch.autograd.backward(loss)
    assert float(loss.detach()) == pytest.approx((0.006 + 2.0) / 2)
    assert scales.grad is not None
    assert (scales.grad > 0.0).all()
