"""A joint adjustment as a problem of least squares: poses step, and depths follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.optimise.least_squares import NormalEquations, Rules, minimise
from aquaflow.tracking.adjustment.block_matrix import BlockPattern
from aquaflow.tracking.adjustment.equations import (
    KERNEL,
    AnchorEquations,
    AnchorMatches,
    Array,
    Mask,
    anchor_equations,
    project,
)
from aquaflow.tracking.adjustment.links import Links

DECREASE = 1e-4
"""Relative fall of the cost at which a descent ends."""
DENSE_UNKNOWNS = 700
"""Up to a hundred keyframes a dense factor is quicker than a sparse one."""
KEPT_BYTES = 64 << 20
"""What steps of depths are kept from, 0.1 MB for each anchor; making them anew takes as long as the
equations did."""


@dataclass(frozen=True)
class BundleState:
    """What is solved for."""

    poses: Sim3Batch
    """[K] T_wc; the scale is the unit of the keyframe's depths."""
    rho: Sequence[Array]
    """[P] of each anchor."""


def cost_of(matches: Sequence[AnchorMatches], links: Links, state: BundleState) -> float:
    """Robust cost of all matches, and of the depths' departure from the pointmaps."""
    total = links.cost(state.poses)
    for anchor, rho in zip(matches, state.rho, strict=True):
        error = project(anchor, state.poses, rho).error
        size = np.linalg.norm(error, axis=-1) / anchor.sigma[:, None]
        total += float(KERNEL.cost(size).sum())
        total += 0.5 * float(((rho - anchor.rho) ** 2 / anchor.variance).sum())
    return total


def descend(
    matches: Sequence[AnchorMatches],
    links: Links,
    state: BundleState,
    free: Mask,  # [K] which poses may move
    iterations: int,
) -> BundleState:
    """The state of least cost, or the best that ``iterations`` steps find."""
    problem = JointAdjustment(matches, links, free)
    return minimise(problem, state, Rules(iterations, decrease=DECREASE)).state


class JointAdjustment:
    """Matches and links; F poses are free."""

    def __init__(
        self,
        matches: Sequence[AnchorMatches],
        links: Links,
        free: Mask,  # [K]
    ) -> None:
        self._matches, self._links, self._free = matches, links, free
        self._pattern = BlockPattern.of(matches, links, free)
        self._system: System | None = None
        self._known: tuple[BundleState, float] | None = None

    def cost(self, state: BundleState) -> float:
        """Robust; infinite where a pose is none."""
        if self._known is None or self._known[0] is not state:
            poses = state.poses
            sound = np.isfinite(poses.t).all() and (poses.scale > 0.0).all()
            cost = cost_of(self._matches, self._links, state) if sound else float("inf")
            self._known = state, cost
        return self._known[1]

    def linearise(self, state: BundleState) -> System:
        """The equations of a step [7 F]."""
        system = linearise(self._matches, self._links, state, self._pattern)
        self._system = replace(system, cost=self.cost(state))
        return self._system

    def move(
        self,
        state: BundleState,
        step: Array,  # [P]
    ) -> BundleState:
        """Poses moved by a step [7 F], and the depths that fit best then, to first order."""
        assert self._system is not None
        whole = np.zeros((len(state.poses), 7))
        whole[self._free] = step.reshape(-1, 7)
        rho, parts = [], self._system.parts
        for i, (anchor, depths) in enumerate(zip(self._matches, state.rho, strict=True)):
            part = parts[i] if i < len(parts) else anchor_equations(anchor, state.poses, depths)
            rho.append(depths + part.depth_steps(whole[anchor.places].ravel()))
        return BundleState((state.poses @ Sim3Batch.exp(whole)).on_group(), rho)


@dataclass(frozen=True)
class System:
    """The equations at one state."""

    H: sparse.csc_matrix
    """[7 F, 7 F] of the free poses, depths eliminated."""
    gradient: Array
    """[7 F]"""
    parts: Sequence[AnchorEquations]
    """Of the first anchors, as many as KEPT_BYTES hold: those of the others are made anew when
    their depths step."""
    cost: float = float("nan")

    def solve(self, damping: float) -> Array | None:
        """[7 F] damped step of the free poses; None where the equations are singular."""
        if len(self.gradient) <= DENSE_UNKNOWNS:
            return NormalEquations(self.H.toarray(), self.gradient, self.cost).solve(damping)
        diagonal = self.H.diagonal()
        least = 1e-12 * max(float(diagonal.max(initial=0.0)), 1e-12)
        H = self.H + sparse.diags((damping * diagonal) + least, format="csc")
        try:
            factor = splu(H, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        except RuntimeError:
            return None
        step = np.asarray(-factor.solve(self.gradient))
        return step if np.isfinite(step).all() else None


def linearise(
    matches: Sequence[AnchorMatches], links: Links, state: BundleState, pattern: BlockPattern
) -> System:
    """The equations of all anchors and links, summed anchor by anchor."""
    total, kept, room = pattern.zero(), list[AnchorEquations](), KEPT_BYTES
    for anchor, rho in zip(matches, state.rho, strict=True):
        part = anchor_equations(anchor, state.poses, rho)
        total.add(pattern.place[anchor.places], part.H, part.gradient)
        room -= part.gain.nbytes
        if room >= 0:
            kept.append(part)
    ends = pattern.place[np.stack([links.a, links.b], axis=1)]
    for places, H, gradient in zip(ends, *links.blocks(state.poses), strict=True):
        total.add(places, H, gradient)
    return System(total.matrix(), total.gradient, kept)
