"""Adam of small tensors against torch's class, and what it does without."""

from __future__ import annotations

import subprocess
import sys

import torch

from aquaflow.render.dense_adam import STEP, DenseAdam

STEPS = 50


def tensors() -> list[torch.nn.Parameter]:
    generator = torch.Generator().manual_seed(3)
    shapes: list[tuple[int, ...]] = [(3,), (4, 2), (), (5,)]
    return [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in shapes]


def test_it_steps_as_torchs_to_the_bit_also_where_gradients_are_missing() -> None:
    ours, theirs = tensors(), tensors()
    adam = DenseAdam(
        [{"params": ours[:2], "lr": 0.01}, {"params": ours[2:], "lr": 0.3}], (0.8, 0.99)
    )
    groups = [{"params": theirs[:2], "lr": 0.01}, {"params": theirs[2:], "lr": 0.3}]
    reference = torch.optim.Adam(groups, betas=(0.8, 0.99))
    generator = torch.Generator().manual_seed(4)
    for k in range(STEPS):
        adam.forget_gradients()
        reference.zero_grad(set_to_none=True)
        for i, (mine, other) in enumerate(zip(ours, theirs, strict=True)):
            if (i + k) % 3:
                mine.grad = torch.randn(mine.shape, generator=generator)
                other.grad = mine.grad.clone()
        if k == STEPS // 2:
            adam.rates[1] = reference.param_groups[1]["lr"] = 0.05
        adam.step()
        reference.step()
    for i, (mine, other) in enumerate(zip(ours, theirs, strict=True)):
        assert torch.equal(mine, other)
        for part, value in reference.state[other].items():
            assert torch.equal(adam.state[i][part], value), part


def test_a_tensor_without_a_gradient_keeps_its_value_and_has_no_state() -> None:
    (first, *_) = tensors()
    adam = DenseAdam([{"params": [first], "lr": 0.1}])
    before = first.detach().clone()
    adam.step()
    assert torch.equal(first, before)
    assert adam.state == {}
    first.grad = torch.ones(3)
    adam.step()
    assert adam.state[0][STEP] == 1.0


def test_torchs_compiler_is_not_loaded() -> None:
    """A second and 72 MB at a dive's first keyframe."""
    program = """
import sys, torch
from aquaflow.render.dense_adam import DenseAdam
weight = torch.nn.Parameter(torch.ones(3))
weight.grad = torch.ones(3)
DenseAdam([{"params": [weight], "lr": 0.1}]).step()
torch.nn.utils.clip_grad_norm_([weight], 1.0)
sys.exit("torch._dynamo" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
