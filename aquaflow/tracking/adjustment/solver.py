"""Levenberg-Marquardt over keyframe poses, and the covariance that it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from aquaflow.geometry.similarity_batch import Sim3Batch
from aquaflow.tracking.adjustment.equations import (
    AnchorEquations,
    AnchorMatches,
    Array,
    Index,
    Mask,
    anchor_equations,
    projected,
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


@dataclass(frozen=True)
class State:
    """What is solved for."""

    poses: Sim3Batch
    """[K] T_wc; the scale is the unit of the keyframe's depths."""
    rho: Sequence[Array]
    """[P] of each anchor."""


def cost_of(matches: Sequence[AnchorMatches], links: Links, state: State) -> float:
    """Robust cost of all matches, and of the depths' departure from the pointmaps."""
    total = links.cost(state.poses)
    for anchor, rho in zip(matches, state.rho, strict=True):
        error = projected(anchor, state.poses, rho).error
        size = np.linalg.norm(error, axis=-1) / anchor.sigma[:, None]
        total += float(huber_cost(size).sum())
        total += 0.5 * float(((rho - anchor.rho) ** 2 / anchor.variance).sum())
    return total


def descend(
    matches: Sequence[AnchorMatches],
    links: Links,
    state: State,
    free: Mask,  # [K] which poses may move
    iterations: int,
) -> State:
    """The state of least cost, or the best that ``iterations`` steps find."""
    damping, cost = FIRST_DAMPING, cost_of(matches, links, state)
    equations = None
    for _ in range(iterations):
        if equations is None:
            equations = linearised(matches, state)
        candidate = _stepped(matches, links, state, equations, free, damping)
        new_cost = np.inf if candidate is None else cost_of(matches, links, candidate)
        if candidate is None or not new_cost < cost:
            damping *= 10.0
            if damping > LARGEST_DAMPING:
                break
            continue
        decrease = (cost - new_cost) / max(cost, 1e-12)
        state, cost, equations = candidate, new_cost, None
        damping = max(0.1 * damping, 1e-9)
        if decrease < STOP_RELATIVE_DECREASE:
            break
    return state


def linearised(matches: Sequence[AnchorMatches], state: State) -> list[AnchorEquations]:
    """The equations of every anchor."""
    return [
        anchor_equations(anchor, state.poses, rho)
        for anchor, rho in zip(matches, state.rho, strict=True)
    ]


def _stepped(
    matches: Sequence[AnchorMatches],
    links: Links,
    state: State,
    equations: Sequence[AnchorEquations],
    free: Mask,  # [K]
    damping: float,
) -> State | None:
    """The state after a damped step; None if the equations have no solution."""
    step = np.zeros((len(state.poses), 7))
    system = assembled(matches, equations, links, state.poses, free)
    step[free] = solved(*system, damping)
    poses = (state.poses @ Sim3Batch.exp(step)).on_group()
    if not (np.isfinite(step).all() and np.isfinite(poses.t).all() and (poses.scale > 0).all()):
        return None
    rho = [
        rho + part.depth_steps(step[anchor.places].ravel())
        for anchor, rho, part in zip(matches, state.rho, equations, strict=True)
    ]
    return State(poses, rho)


def solved(
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


def assembled(
    matches: Sequence[AnchorMatches],
    equations: Sequence[AnchorEquations],
    links: Links,
    poses: Sim3Batch,
    free: Mask,  # [K]
) -> tuple[sparse.csc_matrix, Array]:
    """The reduced normal equations of the free poses: [7 F, 7 F] and the gradient [7 F]."""
    place = np.full(len(free), -1, dtype=np.intp)
    place[free] = np.arange(int(free.sum()))
    parts = [
        (place[anchor.places], part.H, part.gradient)
        for anchor, part in zip(matches, equations, strict=True)
    ]
    ends = place[np.stack([links.a, links.b], axis=1)]
    parts += list(zip(ends, *links.blocks(poses), strict=True))
    size = 7 * int(free.sum())
    total, values, rows, columns = np.zeros(size), [], [], []
    for places, H, gradient in parts:
        at, inside = unknowns(places)
        np.add.at(total, at, gradient[inside])
        values.append(H[np.ix_(inside, inside)].ravel())
        rows.append(np.repeat(at, len(at)))
        columns.append(np.tile(at, len(at)))
    if not values:
        return sparse.csc_matrix((size, size)), total
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csc_matrix(entries, shape=(size, size)), total


def unknowns(
    places: Index,  # [1 + V] among the free poses; -1 for those that are held
) -> tuple[Index, Index]:
    """Unknowns [u] of the free ones among ``places``, and where they stand in their block [u]."""
    columns = (7 * places[:, None] + np.arange(7)).ravel()
    inside = np.flatnonzero(np.repeat(places >= 0, 7))
    return columns[inside], inside
