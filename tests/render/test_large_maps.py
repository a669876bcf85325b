"""Maps of two million Gaussians through the Python renderer, in bounded memory."""

from __future__ import annotations

import subprocess
import sys

import pytest

from aquaflow.render.native import build as native

MEMORY_GB = 1.5
"""What forward and backward may take above the inputs; 0.7 GB on two threads, half of it for the
threads' gradients."""

DRAW = """
import resource
import torch
from aquaflow.render.cpu import CpuRenderer

n = 2_000_000
rng = torch.Generator().manual_seed(0)
depth = 1 + 4 * torch.rand(n, 1, generator=rng)
ray = torch.rand(n, 2, generator=rng) * torch.tensor([1.2, 0.9]) - torch.tensor([0.6, 0.45])
tensors = [torch.cat([ray * depth, depth], 1), torch.randn(n, 4, generator=rng),
           depth / 400 * torch.rand(n, 3, generator=rng), torch.rand(n, generator=rng),
           torch.rand(n, 4, generator=rng), torch.eye(4)]
leaves = [tensor.requires_grad_() for tensor in tensors]
K = torch.tensor([[270.0, 0.0, 160.0], [0.0, 270.0, 120.0], [0.0, 0.0, 1.0]])
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
before = peak()
renderer = CpuRenderer(2)
out = renderer(*leaves, K, 320, 240)
(out.image.sum() + out.alpha.sum()).backward()
assert out.visible.sum() > n // 2
assert all(leaf.grad.isfinite().all() and leaf.grad.any() for leaf in leaves)
print(peak() - before)
"""


@pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")
@pytest.mark.ci
def test_two_million_gaussians_are_drawn_and_differentiated_in_bounded_memory() -> None:
    done = subprocess.run([sys.executable, "-c", DRAW], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < MEMORY_GB * 1e9
