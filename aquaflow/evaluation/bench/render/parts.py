"""The other two costs of a mapping step: the photometric loss, and the optimiser against torch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from aquaflow.evaluation.bench.render.timing import Clock, interleaved, spread_of, torch_threads
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.photometric import photometric_loss

PICTURES = ((320, 240), (640, 480))
ROWS = (30_000, 100_000)
"""Sizes of pictures, and numbers of Gaussians."""
SEEN_SHARES = (1.0, 0.3)
"""Of the Gaussians: what a view shows of a map."""
WIDTHS = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "colours": 3}
"""Numbers of one Gaussian that an optimiser steps."""
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

    def timed(self, clock: Clock) -> tuple[float, float]:
        """Milliseconds on the wall, and of this thread's CPU time."""
        with torch_threads(self.threads if self.uses_torch_threads else 1):
            begin = clock.wall(), clock.cpu()
            self.run()
            return 1e3 * (clock.wall() - begin[0]), 1e3 * (clock.cpu() - begin[1])


def parts_of(
    threads: Iterable[int],
    pictures: Sequence[tuple[int, int]] = PICTURES,
    rows: Sequence[int] = ROWS,
) -> list[TimedPart]:
    """Loss with gradient on each picture, optimiser step for each number of Gaussians."""
    found: list[TimedPart] = []
    for count in threads:
        found += [_loss(*picture, count) for picture in pictures]
        for n in rows:
            found += _optimisers(n, count)
    return found


def _loss(width: int, height: int, threads: int) -> TimedPart:
    rng = torch.Generator().manual_seed(0)
    rendered, target = torch.rand(2, height, width, 3, generator=rng)
    weight = torch.rand(height, width, generator=rng)
    mask = torch.rand(height, width, generator=rng) > 0.1
    leaf = rendered.requires_grad_()

    def loss_and_gradient() -> object:
        loss = photometric_loss(leaf, target, weight, mask, SSIM_WEIGHT, threads)
        return torch.autograd.grad(loss, leaf)

    return TimedPart("L1 + SSIM", f"{width} x {height}", "fused", threads, loss_and_gradient)


def _optimisers(n: int, threads: int) -> list[TimedPart]:
    rng = torch.Generator().manual_seed(0)

    def tensors() -> dict[str, Tensor]:
        return {name: torch.randn(n, width, generator=rng) for name, width in WIDTHS.items()}

    gradients, work = tensors(), f"{n} Gaussians"
    groups = {name: (tensor, LEARNING_RATE) for name, tensor in tensors().items()}
    ours = SelectiveAdam(groups, threads=threads)
    parameters = list(tensors().values())
    for parameter, gradient in zip(parameters, gradients.values(), strict=True):
        parameter.grad = gradient
    fused = torch.optim.Adam(parameters, lr=LEARNING_RATE, fused=True)
    found = [TimedPart("Adam", work, "torch, fused", threads, fused.step, True)]
    for share in SEEN_SHARES:
        seen = torch.rand(n, generator=rng) < share
        step = partial(ours.step, seen, gradients)
        found.append(TimedPart("Adam", work, f"selective, {share:.0%} seen", threads, step))
    return found


def time_parts(
    parts: Sequence[TimedPart], repeats: int, tick: Callable[[], None], clock: Clock | None = None
) -> list[dict[str, Any]]:
    """A row for each part, in their order; the first run of each is not counted."""
    clock = clock or Clock()

    def job(part: TimedPart) -> Callable[[], tuple[float, float]]:
        def timed() -> tuple[float, float]:
            sample = part.timed(clock)
            tick()
            return sample

        return timed

    for part in parts:
        part.timed(clock)
    results = interleaved([job(part) for part in parts], repeats)
    return [_row(part, samples) for part, samples in zip(parts, results, strict=True)]


def _row(part: TimedPart, samples: Sequence[tuple[float, float]]) -> dict[str, Any]:
    wall = spread_of([ms for ms, _ in samples])
    return {
        "part": part.name,
        "work": part.work,
        "variant": part.variant,
        "threads": part.threads,
        "repeats": wall.runs,
        "ms": wall.median,
        "ms_half_range": wall.half_range,
        "cpu_ms": spread_of([cpu for _, cpu in samples]).median if part.threads == 1 else None,
    }
