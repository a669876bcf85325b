"""The accuracy bar: 20 random scenes against the float64 reference, on every instruction set."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from aquaflow.render.contract import Rendering
from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.native import build as native
from tests.render.render_scenes import (
    NAMES,
    Scene,
    draw_and_differentiate,
    random_scene,
    reference,
    relative_error,
)

SEEDS = range(20)
IMAGE_ERROR, GRADIENT_ERROR = 1e-4, 5e-5


def rotation(axis: Tensor, angle_rad: float) -> Tensor:
    """[3, 3] by Rodrigues' formula; ``axis`` [3] of length one."""
    x, y, z = axis.tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return torch.eye(3) + math.sin(angle_rad) * cross + (1 - math.cos(angle_rad)) * cross @ cross


def hard_scene(seed: int) -> Scene:
    """Overlapping Gaussians before a camera turned any way; some tiny, huge, thin or behind it."""
    rng = torch.Generator().manual_seed(1000 + seed)
    scene = random_scene(seed, n=150, sigma_m=0.03 + 0.01 * seed, channels=3 + seed % 2)
    axis = torch.nn.functional.normalize(torch.randn(3, generator=rng), dim=0)
    turn = rotation(axis, math.pi * float(torch.rand((), generator=rng)))
    viewmat = torch.eye(4)
    viewmat[:3, :3] = turn
    viewmat[:3, 3] = torch.randn(3, generator=rng)
    camera = scene.means @ scene.viewmat[:3, :3].T + scene.viewmat[:3, 3]
    camera[::10, 2] *= -1.0  # behind
    camera[1::30, 2] = 0.05 + 0.1 * torch.rand(5, generator=rng)  # close to the near plane
    scales = scene.scales.clone()
    scales[2::10] = 1e-6
    scales[3::50] = 2.0
    scales[4::10, 0] *= 1e-3
    means = (camera - viewmat[:3, 3]) @ turn
    return replace(scene, means=means, scales=scales, viewmat=viewmat)


@cache
def wanted_of(seed: int) -> tuple[Rendering, list[Tensor]]:
    return reference(hard_scene(seed))


@pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")
@pytest.mark.parametrize("isa", native.supported_isas())
@pytest.mark.parametrize("seed", SEEDS)
def test_pictures_and_gradients_keep_the_bar(isa: str, seed: int) -> None:
    wanted, wanted_gradients = wanted_of(seed)
    got, gradients = draw_and_differentiate(CpuRenderer(2, isa), hard_scene(seed))
    assert wanted.visible.sum() > 50
    assert (got.image - wanted.image).abs().max() < IMAGE_ERROR
    assert (got.alpha - wanted.alpha).abs().max() < IMAGE_ERROR
    for name, gradient, expected in zip(NAMES, gradients, wanted_gradients, strict=True):
        assert relative_error(gradient, expected) < GRADIENT_ERROR, name
