"""float32 as it runs against float64 as it is defined: relative error of every stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.stress.case import Check, case
from aquaflow.lab.stress.gaussians import cloud, draw
from aquaflow.lab.stress.swim import CAMERA as VIEW
from aquaflow.lab.stress.swim import pose
from aquaflow.render import select_renderer
from aquaflow.render.photometric import photometric_loss, photometric_loss_torch
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.render.water import compose_water, compose_water_torch
from aquaflow.tracking.pose.solver import PoseProblem, solve_pose

HEIGHT, WIDTH = 24, 32
"""Of random pictures, wider than SSIM's window."""


def _relative(
    got: Tensor,  # [...]
    wanted: Tensor,  # [...] as got
) -> float:
    """Norm of the difference over the norm of ``wanted``."""
    difference = got.detach().double() - wanted.detach()
    return float(difference.norm() / wanted.detach().norm().clamp_min(1e-30))


def _leaves(
    tensors: Sequence[Tensor],  # [...] each
    dtype: torch.dtype,
) -> list[Tensor]:
    return [tensor.detach().to(dtype).requires_grad_() for tensor in tensors]


def _gradients_agree(
    check: Check,
    stage: str,
    single: Sequence[Tensor],  # [...] each, float32
    double: Sequence[Tensor],  # [...] each, float64
    bound: float,
) -> None:
    for a, b in zip(single, double, strict=True):
        assert a.grad is not None
        assert b.grad is not None
        check.below(f"{stage}: relative error of a gradient", _relative(a.grad, b.grad), bound)


@case("precision", "render.contract.Renderer")
def renderer_in_float32(check: Check, seed: int) -> None:
    """Picture and gradients of the compiled renderer against the float64 reference."""
    inputs = [*cloud(seed).tensors(), torch.eye(4)]
    single, double = _leaves(inputs, torch.float32), _leaves(inputs, torch.float64)
    pictures = []
    for renderer, leaves in ((select_renderer("auto", 1), single), (ReferenceRenderer(), double)):
        drawn = draw(renderer, leaves)
        pictures.append(drawn.image)
        (drawn.image.sum() + drawn.alpha.sum()).backward()  # type: ignore[no-untyped-call]
    check.below("renderer: relative error", _relative(*pictures), 1e-4)
    _gradients_agree(check, "renderer", single, double, 1e-3)


@case("precision", "render.photometric.photometric_loss")
def loss_in_float32(check: Check, seed: int) -> None:
    """The fused loss and its gradient against the definition in float64."""
    rng = torch.Generator().manual_seed(seed)
    a, b = (torch.rand(HEIGHT, WIDTH, 3, generator=rng) for _ in range(2))
    weight = torch.ones(HEIGHT, WIDTH)
    single, double = _leaves([a], torch.float32), _leaves([a], torch.float64)
    fused = photometric_loss(single[0], b, weight, None, 0.2, 1)
    plain = photometric_loss_torch(double[0], b.double(), weight.double(), None, 0.2)
    fused.backward()  # type: ignore[no-untyped-call]
    plain.backward()  # type: ignore[no-untyped-call]
    check.below("loss: relative error", _relative(fused, plain), 1e-5)
    _gradients_agree(check, "loss", single, double, 1e-4)


@case("precision", "render.water.compose_water")
def medium_in_float32(check: Check, seed: int) -> None:
    """The fused water and its gradients against the definition in float64."""
    rng = torch.Generator().manual_seed(seed)
    alpha = 0.2 + 0.8 * torch.rand(HEIGHT, WIDTH, generator=rng)
    drawn = torch.rand(HEIGHT, WIDTH, 4, generator=rng) * alpha[..., None]
    inputs = [drawn, alpha, 0.05 + torch.rand(5, 3, generator=rng)]
    single, double = _leaves(inputs, torch.float32), _leaves(inputs, torch.float64)
    fused, plain = (
        compose_water(single[0], single[1], single[2])[0],
        compose_water_torch(*double)[0],
    )
    fused.sum().backward()  # type: ignore[no-untyped-call]
    plain.sum().backward()  # type: ignore[no-untyped-call]
    check.below("medium: relative error", _relative(fused, plain), 1e-5)
    _gradients_agree(check, "medium", single, double, 1e-4)


@case("precision", "tracking.pose.solver.solve_pose")
def pose_solver_from_float32(check: Check, seed: int) -> None:
    """The pose from points and matches rounded to float32, as the prior hands them over."""
    rng = np.random.default_rng(seed)
    pixels = np.stack([rng.uniform(2, 158, 200), rng.uniform(2, 118, 200)], -1)
    points = VIEW.unproject(pixels) * rng.uniform(0.8, 2.5, (200, 1))
    truth = pose((0.1, 0.05, -0.02), (0.01, 0.03, -0.02))
    seen = VIEW.project(truth.apply(points))
    exact = _solve(points, seen)
    rounded = _solve(points.astype(np.float32).astype(float), seen.astype(np.float32).astype(float))
    size = float(np.linalg.norm(exact.t))
    check.below("pose: relative error", float(np.linalg.norm(rounded.t - exact.t)) / size, 1e-5)
    check.below("pose: error of R", float(np.abs(rounded.R - exact.R).max()), 1e-6)


def _solve(
    points: npt.NDArray[np.float64],  # [N, 3]
    pixels: npt.NDArray[np.float64],  # [N, 2] px
) -> Sim3:
    ones = np.ones(len(points))
    estimate = solve_pose(
        PoseProblem(points, 1e-6 * ones, pixels, ones, VIEW, 0.5), Sim3.identity()
    )
    assert estimate is not None
    return estimate.T
