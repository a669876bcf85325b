"""Selects the view of each optimiser step, and how far it goes (paper, Sec. 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from aquaflow.config import OptimiserConfig
from aquaflow.render.views import View


def sampled_views(
    views: Sequence[View],
    steps: int,
    newest_share: float,
    generator: torch.Generator,
) -> list[View]:
    """One view for each step during the dive: sometimes the newest, else a random one."""
    chosen = []
    for _ in range(steps if views else 0):
        newest = torch.rand((), generator=generator) < newest_share
        index = int(torch.randint(len(views), (), generator=generator))
        chosen.append(views[-1 if newest else index])
    return chosen


def shuffled_views(views: Sequence[View], steps: int, generator: torch.Generator) -> list[View]:
    """One view a step after the dive: all of them in random order, then again in another."""
    order: list[int] = []
    while views and len(order) < steps:
        order += reversed(torch.randperm(len(views), generator=generator).tolist())
    return [views[index] for index in order[:steps]]


@dataclass(frozen=True)
class Rates:
    """Factors of the learning rates."""

    means: float
    others: float


def refining_rates(done: float, config: OptimiserConfig) -> Rates:
    """The rates after the share ``done`` of refining.

    Those of the means fall from the start. At the end all fall: what each view pulls its own way
    settles at the mean of the views.
    """
    left = 1.0 - config.settle_share
    settling = max(done - left, 0.0) / config.settle_share if config.settle_share else 0.0
    others = config.settle_final**settling
    return Rates(config.means_final**done * others, others)
