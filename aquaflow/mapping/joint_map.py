"""One set of Gaussians that several dives see, each through its own water and in its own light."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import torch

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.mapping.gaussians import GaussianMap
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.optimisation import share_done, shuffled_views
from aquaflow.render.transfers import water_in

SEED = 0
"""Of the order of the views."""


@dataclass(frozen=True)
class Member:
    """A dive's map, moved into the joint world."""

    mapper: Mapper
    scale: float
    """Length in the joint unit over that in the map's own, in which its water is."""
    gains: tuple[float, float, float]
    """Radiance in the joint light over that in the dive's."""


class JointMap:
    """The maps of several dives, in one world, with the same Gaussians."""

    def __init__(self, gaussians: GaussianMap, members: Sequence[Member]) -> None:
        """From here on all maps have these Gaussians, with one optimiser's rows, in place of their
        own and of a decoder's, and look through their own water in their own light."""
        self.gaussians = gaussians
        self.mappers = [member.mapper for member in members]
        for member in members:
            _join(member, gaussians)
        first = self.mappers[0].optimiser
        first.make_whole()
        for mapper in self.mappers[1:]:
            mapper.optimiser.adam = first.adam

    def refine(
        self,
        mappers: Sequence[Mapper],
        steps: int,
        progress: Callable[[int, int], None],
        until: Deadline,
    ) -> int:
        """As :meth:`Mapper.refine`, on the views of these ``mappers`` of the joint map, which have
        their pictures; the steps that were taken."""
        drawn = torch.Generator().manual_seed(SEED)
        owners = [(mapper, view) for mapper in mappers for view in mapper.views]
        owner_of = {id(view): mapper for mapper, view in owners}
        order = shuffled_views([view for _, view in owners], steps, drawn)
        taken = 0
        with ExitStack() as stack:
            for mapper in self.mappers:
                stack.enter_context(mapper.optimiser.stepping())
            for step, view in enumerate(order):
                passed = until.passed
                if passed >= 1.0 or len(self.gaussians) == 0:
                    break
                if step % len(owners) == 0:
                    for mapper in mappers:
                        mapper.judge_light(mapper.views)
                done = share_done(step, steps, passed)
                if not owner_of[id(view)].refine_step(view, done):
                    break
                taken += 1
                progress(taken, steps)
        return taken


@torch.no_grad()
def _join(member: Member, gaussians: GaussianMap) -> None:
    mapper = member.mapper
    gain = water_in(np.array(member.gains), mapper.device)
    mapper.scene.go_on()
    mapper.scene.neural, mapper.scene.gaussians = None, gaussians
    mapper.scene.use_unit_and_light(member.scale, gain)
    for view in mapper.views:
        view.log_gain = view.log_gain - gain.double().log()
