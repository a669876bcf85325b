"""The fused L1 + SSIM loss against its definition in float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.photometric import photometric_loss, photometric_loss_torch, ssim


def images(height: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rng = torch.Generator().manual_seed(3)
    target = torch.rand(height, width, 3, generator=rng)
    rendered = (target + 0.2 * torch.randn(height, width, 3, generator=rng)).clamp(0, 1.1)
    weight = 2 * torch.rand(height, width, generator=rng)
    mask = torch.rand(height, width, generator=rng) > 0.2
    return rendered, target, weight, mask


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 40), (40, 3), (41, 67), (12, 11)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("threads", [1, 3])
def test_fused_loss_and_gradient_agree_with_float64_autograd(
    height: int, width: int, masked: bool, ssim_weight: float, threads: int
) -> None:
    rendered, target, weight, every = images(height, width)
    mask = every if masked else None
    exact = rendered.double().requires_grad_()
    wanted = photometric_loss_torch(exact, target.double(), weight.double(), mask, ssim_weight)
    wanted.backward()
    plain = rendered.clone().requires_grad_()
    got = photometric_loss(plain, target, weight, mask, ssim_weight, threads)
    (3 * got).backward()
    assert got.item() == pytest.approx(wanted.item(), rel=1e-5, abs=1e-6)
    assert plain.grad is not None
    assert exact.grad is not None
    error = (plain.grad / 3 - exact.grad).norm()
    assert error <= 2e-5 * exact.grad.norm() + 1e-7


def test_masked_pixels_take_no_gradient() -> None:
    rendered, target, weight, mask = images(30, 30)
    rendered.requires_grad_()
    photometric_loss(rendered, target, weight, mask, 0.2).backward()
    assert rendered.grad is not None
    assert not rendered.grad[~mask].any()


def test_equal_images_have_no_loss_and_no_gradient() -> None:
    _, target, weight, _ = images(25, 31)
    rendered = target.clone().requires_grad_()
    loss = photometric_loss(rendered, target, weight, None, 0.2)
    loss.backward()
    assert loss.item() == pytest.approx(0.0, abs=1e-6)
    assert rendered.grad is not None
    assert rendered.grad.abs().max() < 1e-6


@pytest.mark.parametrize("threads", [2, 3, 5, 40])
def test_loss_and_gradient_do_not_depend_on_the_number_of_threads(threads: int) -> None:
    rendered, target, weight, mask = images(51, 43)
    results = []
    for count in (1, threads):
        leaf = rendered.clone().requires_grad_()
        loss = photometric_loss(leaf, target, weight, mask, 0.2, count)
        results.append((loss, *torch.autograd.grad(loss, leaf)))
    assert all(map(torch.equal, *results))


def test_ssim_of_constant_images_has_its_closed_form() -> None:
    a, b = torch.full((40, 40, 3), 0.2), torch.full((40, 40, 3), 0.6)
    inner = ssim(a.double(), b.double())
    # zero padding only lowers the means near the border: the centre follows the formula
    centre = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    assert inner.item() <= centre + 1e-9


def test_without_a_library_torch_computes_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rendered, target, weight, mask = images(20, 30)
    fused = photometric_loss(rendered, target, weight, mask, 0.2)
    monkeypatch.setattr("aquaflow.render.photometric.library_or_none", lambda: None)
    plain = photometric_loss(rendered, target, weight, mask, 0.2)
    assert plain.item() == pytest.approx(fused.item(), rel=1e-5)


def test_a_wrong_shape_is_named() -> None:
    rendered, target, weight, _ = images(20, 30)
    with pytest.raises(AquaFlowError, match="weight"):
        photometric_loss(rendered, target, weight.T, None, 0.2)
