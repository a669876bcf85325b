"""Levenberg-Marquardt over keyframe poses, and the covariance that it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from aquaflow.geometry.similarity_batch import Sim3Batch
from aquaflow.tracking.adjustment.block_matrix import BlockPattern
from aquaflow.tracking.adjustment.equations import (
    AnchorEquations,
    AnchorMatches,
    Array,
    Mask,
    anchor_equations,
    project,
)
from aquaflow.tracking.adjustment.links import Links
from aquaflow.tracking.adjustment.robust import huber_cost

FIRST_DAMPING = 1e-4
"""Relative to the diagonal."""
LARGEST_DAMPING = 1e6
STOP_RELATIVE_DECREASE = 1e-4
"""Of the cost, at which the descent ends."""
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
        total += float(huber_cost(size).sum())
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
    damping, cost = FIRST_DAMPING, cost_of(matches, links, state)
    pattern, system = None, None
    for _ in range(iterations):
        pattern = pattern or BlockPattern.of(matches, links, free)
        system = system or linearise(matches, links, state, pattern)
        candidate = _step(matches, state, system, free, damping)
        new_cost = np.inf if candidate is None else cost_of(matches, links, candidate)
        if candidate is None or not new_cost < cost:
            damping *= 10.0
            if damping > LARGEST_DAMPING:
                break
            continue
        decrease = (cost - new_cost) / max(cost, 1e-12)
        state, cost, system = candidate, new_cost, None
        damping = max(0.1 * damping, 1e-9)
        if decrease < STOP_RELATIVE_DECREASE:
            break
    return state


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


def _step(
    matches: Sequence[AnchorMatches],
    state: BundleState,
    system: System,
    free: Mask,  # [K]
    damping: float,
) -> BundleState | None:
    """The state after a damped step; None if the equations have no solution."""
    step = np.zeros((len(state.poses), 7))
    step[free] = solve(system.H, system.gradient, damping)
    poses = (state.poses @ Sim3Batch.exp(step)).on_group()
    if not (np.isfinite(step).all() and np.isfinite(poses.t).all() and (poses.scale > 0).all()):
        return None
    rho = []
    for i, (anchor, depths) in enumerate(zip(matches, state.rho, strict=True)):
        kept = i < len(system.parts)
        part = system.parts[i] if kept else anchor_equations(anchor, state.poses, depths)
        rho.append(depths + part.depth_steps(step[anchor.places].ravel()))
    return BundleState(poses, rho)


def solve(
    H: sparse.csc_matrix,
    gradient: Array,  # [7 F]
    damping: float,
) -> Array:
    """[F, 7] step of the free poses; NaN where the equations are singular."""
    diagonal = H.diagonal()
    least = 1e-12 * max(float(diagonal.max(initial=0.0)), 1e-12)
    H = H + sparse.diags((damping * diagonal) + least, format="csc")
    if len(gradient) <= DENSE_UNKNOWNS:
        try:
            return np.asarray(-np.linalg.solve(H.toarray(), gradient)).reshape(-1, 7)
        except np.linalg.LinAlgError:
            return np.full((len(gradient) // 7, 7), np.nan)
    try:
        factor = splu(H, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError:
        return np.full((len(gradient) // 7, 7), np.nan)
    return np.asarray(-factor.solve(gradient)).reshape(-1, 7)
