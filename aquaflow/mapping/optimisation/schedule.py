"""Selects the view of each optimiser step (paper, Sec. 3.4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from aquaflow.mapping.views import View


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
