"""A renderer whose time is known, for tests of the renderer's benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from aquaflow.lab.bench.render.peak import PeakRate
from aquaflow.lab.bench.render.timing import Clock
from aquaflow.render.contract import CPU, Rendering
from aquaflow.render.example_scene import Size

TINY = Size(200, 52, 39)  # no multiple of a tile
PEAK = PeakRate({1: 1e9, 2: 2e9}, "nothing")


@dataclass
class SlowedClock:
    """Time that passes only when somebody works: half of it on the processor."""

    now: float = 0.0

    def clock(self) -> Clock:
        return Clock(lambda: self.now, lambda: self.now / 2.0)


@dataclass
class Pretended:
    """A renderer that takes 10 ms forward and 30 ms backward."""

    time: SlowedClock
    threads: int = 1
    name: str = "pretended"
    isa: str = "none"
    device: torch.device = CPU
    fails_after: int | None = None
    calls: int = 0
    stages: dict[str, float] = field(default_factory=lambda: {"project": 1.0, "blend": 9.0})

    def stage_ms(self) -> Mapping[str, float]:
        return self.stages

    def __call__(self, *inputs: Any) -> Rendering:
        self.calls += 1
        if self.fails_after is not None and self.calls > self.fails_after:
            raise MemoryError("no room\nfor details")
        tensors, (_, width, height) = inputs[:6], inputs[6:9]
        self.time.now += 0.010
        image = _Spend.apply(sum(t.sum() for t in tensors), self.time)  # type: ignore[no-untyped-call]
        alpha = image.expand(height, width)
        none = torch.zeros(0)
        return Rendering(alpha[..., None].expand(-1, -1, 4), alpha, none, none)


class _Spend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, time: SlowedClock) -> Tensor:
        ctx.time = time
        return x.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        ctx.time.now += 0.030
        return gradients[0], None
