"""The other two costs of a mapping step: the photometric loss, and the optimiser against torch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from aquaflow.lab.bench.meter import meter_of
from aquaflow.lab.bench.render.timing import Clock, interleave, spread_of, torch_threads
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.contract import CPU
from aquaflow.render.photometric import photometric_loss

PICTURES = ((320, 240), (640, 480))
ROWS = (30_000, 100_000)
"""Sizes of pictures, and numbers of Gaussians."""
SEEN_SHARES = (1.0, 0.3)
"""Of the Gaussians: what a view shows of a map."""
WIDTHS = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "colours": 3}
"""Numbers of one Gaussian that an optimiser steps."""
FUSED_ON = ("cpu", "cuda")
"""Devices that torch has its fused Adam for."""
SSIM_WEIGHT = 0.2
LEARNING_RATE = 1e-3
"""The weight as the paper has it; any rate, as the time of a step does not depend on it."""


@dataclass(frozen=True)
class TimedPart:
    """One variant of one operation, to be timed repeatedly."""

    name: str
    work: str
    variant: str
    threads: int
    run: Callable[[], object]
    uses_torch_threads: bool = False
    """False: the work has its own threads, and torch's would only spin in addition."""
    device: torch.device = CPU

    def measure_time(self, clock: Clock) -> tuple[float, float]:
        """Milliseconds on the wall, and of this thread's CPU time."""
        meter = meter_of(self.device)
        with torch_threads(self.threads if self.uses_torch_threads else 1):
            meter.settle()
            begin = clock.wall(), clock.cpu()
            self.run()
            meter.settle()
            return 1e3 * (clock.wall() - begin[0]), 1e3 * (clock.cpu() - begin[1])


def parts_of(
    threads: Iterable[int],
    pictures: Sequence[tuple[int, int]] = PICTURES,
    rows: Sequence[int] = ROWS,
    device: torch.device = CPU,
) -> list[TimedPart]:
    """Loss with gradient on each picture, optimiser step for each number of Gaussians."""
    found: list[TimedPart] = []
    for count in threads:
        found += [_loss(*picture, count, device) for picture in pictures]
        for n in rows:
            found += _optimisers(n, count, device)
    return found


def _loss(width: int, height: int, threads: int, device: torch.device) -> TimedPart:
    rng = torch.Generator().manual_seed(0)
    rendered, target = torch.rand(2, height, width, 3, generator=rng).to(device)
    weight = torch.rand(height, width, generator=rng).to(device)
    mask = (torch.rand(height, width, generator=rng) > 0.1).to(device)
    leaf = rendered.requires_grad_()

    def loss_and_gradient() -> object:
        loss = photometric_loss(leaf, target, weight, mask, SSIM_WEIGHT, threads)
        return torch.autograd.grad(loss, leaf)

    variant = "fused" if device == CPU else "torch"
    work = f"{width} x {height}"
    return TimedPart("L1 + SSIM", work, variant, threads, loss_and_gradient, device=device)


def _optimisers(n: int, threads: int, device: torch.device) -> list[TimedPart]:
    rng = torch.Generator().manual_seed(0)

    def tensors() -> dict[str, Tensor]:
        return {
            name: torch.randn(n, width, generator=rng).to(device) for name, width in WIDTHS.items()
        }

    gradients, work = tensors(), f"{n} Gaussians"
    groups = {name: (tensor, LEARNING_RATE) for name, tensor in tensors().items()}
    ours = SelectiveAdam(groups, threads=threads)
    parameters = list(tensors().values())
    for parameter, gradient in zip(parameters, gradients.values(), strict=True):
        parameter.grad = gradient
    is_fused = device.type in FUSED_ON
    theirs = torch.optim.Adam(parameters, lr=LEARNING_RATE, fused=is_fused)
    name = "torch, fused" if is_fused else "torch"
    found = [TimedPart("Adam", work, name, threads, theirs.step, True, device)]
    for share in SEEN_SHARES:
        seen = (torch.rand(n, generator=rng) < share).to(device)
        step = partial(ours.step, seen, gradients)
        name = f"selective, {share:.0%} seen"
        found.append(TimedPart("Adam", work, name, threads, step, device=device))
    return found


def time_parts(
    parts: Sequence[TimedPart], repeats: int, tick: Callable[[], None], clock: Clock | None = None
) -> list[dict[str, Any]]:
    """A row for each part, in their order; the first run of each is not counted."""
    clock = clock or Clock()

    def job(part: TimedPart) -> Callable[[], tuple[float, float]]:
        def timed() -> tuple[float, float]:
            sample = part.measure_time(clock)
            tick()
            return sample

        return timed

    for part in parts:
        part.measure_time(clock)
    results = interleave([job(part) for part in parts], repeats)
    return [_row(part, samples) for part, samples in zip(parts, results, strict=True)]


def _row(part: TimedPart, samples: Sequence[tuple[float, float]]) -> dict[str, Any]:
    wall = spread_of([ms for ms, _ in samples])
    alone = part.threads == 1 and part.device == CPU
    return {
        "part": part.name,
        "work": part.work,
        "variant": part.variant,
        "threads": part.threads,
        "repeats": wall.runs,
        "ms": wall.median,
        "ms_half_range": wall.half_range,
        "cpu_ms": spread_of([cpu for _, cpu in samples]).median if alone else None,
    }
