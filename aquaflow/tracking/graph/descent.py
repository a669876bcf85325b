"""Sparse Levenberg-Marquardt over only those poses of a keyframe graph that move.

The active set starts at what is new and grows, in doubling reach, while a pose at its rim would
move by more than a tolerance.

Why not ``optimise.minimise``: its problem has one set of unknowns and one cost, while here the set
grows and the loops' kernel tightens (graduated non-convexity) on the way, and a factor serves
several steps. Measured, a loop over 20 keyframes of a dive of 200 and of 1000, admission included:
17 and 20 ms of CPU time; the shared descent over all poses, without admission, 14 and 43 ms. A loop
over all 1000: 86 and 60 ms, so that the shared one gains where everything moves, which is rare.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.tracking.graph.equations import (
    DAMPING,
    Array,
    Equations,
    Index,
    Mask,
    Misfit,
    Rows,
    wanted_moves,
)
from aquaflow.tracking.graph.linear_system import LinearSystem

DAMPING_LIMIT = 1e3
"""Damping at which the descent ends: no step reduces the cost."""
LARGEST_TURN = 1.0
"""Rotation (rad) and log-scale of one step; longer steps are shortened as a whole."""
SHORTENINGS = 3
SHORTER = 0.3
"""A step that increases the cost is shortened to this share, at most so many times."""
ANNEALING = 0.5
"""phi over the phi of the step before."""
SETTLING = 0.002
"""Relative fall of the cost below which the next step uses the last factor again."""
INSIDE = 0.3
"""Share of the tolerance to which the active poses are solved, root mean square."""
WHOLE = 0.7
"""Largest squared step in sigmas, of all poses together, at which a descent ends."""
FIRST_REACH = 4
"""Hops that the active set grows at first; doubled each time."""


@dataclass
class Neighbourhood:
    """The active poses, all edges at them and at their neighbours, renumbered from zero."""

    edges: Rows
    """[M]"""
    counts: Mask
    """[M] which edges count."""
    may_move: Mask
    """[N]"""
    active: Mask
    """[N]"""
    asked: Mask
    """[N] other poses that may want to move."""
    used: Index = field(init=False)
    """[m] which edges stand in ``local``."""
    nodes: Index = field(init=False)
    """[n] which poses stand in the local arrays."""
    local: Rows = field(init=False)
    """[m] edges with local ends."""
    rim: Mask = field(init=False)
    """[n] inactive poses that could move; all their edges are in ``local``."""

    def __post_init__(self) -> None:
        a, b = self.edges["a"], self.edges["b"]
        near = self.active | self.asked
        touched = self.counts & (self.active[a] | self.active[b])
        near[a[touched]] = near[b[touched]] = True
        self.used = np.flatnonzero(self.counts & (near[a] | near[b]))
        self.local = self.edges[self.used]
        present = near.copy()
        present[self.local["a"]] = present[self.local["b"]] = True
        self.nodes = np.flatnonzero(present)
        place = np.cumsum(present) - 1
        self.local["a"], self.local["b"] = place[self.local["a"]], place[self.local["b"]]
        self.rim = (near & self.may_move & ~self.active)[self.nodes]

    def grow(
        self,
        wanting: Mask,  # [n] of the local poses
        reach: int,
    ) -> Mask:
        """[N] the active poses and all within ``reach`` hops of local ones that want to move."""
        wider = np.zeros_like(self.active)
        wider[self.nodes[wanting]] = True
        a, b = self.edges["a"][self.counts], self.edges["b"][self.counts]
        for _ in range(reach):
            touched = wider[a] | wider[b]
            wider[a[touched]] = wider[b[touched]] = True
        return self.active | (wider & self.may_move)


class Descent:
    """Moves poses to the least robust cost of the edges that count."""

    def __init__(
        self,
        poses: Sim3Batch,  # [N]
        edges: Rows,  # [M]
        allowed: Array,  # [M] phi of each loop edge; the caller may raise it between runs
        may_move: Mask,  # [N] False for the gauge: the first keyframe of every component
        config: GraphConfig,
    ) -> None:
        self.poses = poses
        self.iterations = 0
        self._edges, self._allowed, self._may_move, self._config = edges, allowed, may_move, config
        self._reach = FIRST_REACH

    def run(
        self,
        counts: Mask,  # [M]
        active: Mask,  # [N]
        asked: Mask,  # [N]
    ) -> Mask:
        """Descend over ``active``, and over all of ``asked`` that want to move.

        Returns:
            [N] the active set at the end.
        """
        tolerance, damping = self._config.tolerance_sigmas, DAMPING
        settled = (INSIDE * tolerance) ** 2
        around, misfit = self._around(counts, active & self._may_move, asked)
        level, again = self._level(misfit.strain), False
        limit = self.iterations + self._config.max_iterations
        while self.iterations < limit and damping < DAMPING_LIMIT:
            at = Equations(misfit, level)
            wanting = wanted_moves(at, around.rim) > tolerance
            if wanting.any():
                active = around.grow(wanting, self._reach)
                self._reach *= 2
                around, misfit = self._around(counts, active, np.zeros_like(active))
                level, again = max(level, self._level(misfit.strain)), False
                continue
            if not around.active.any():
                break
            before = misfit.cost(level)
            trial, gain = self._trial(around, at, level, None if again else damping)
            if trial is None:
                damping, again = damping if again else 10.0 * max(damping, 1e-6), False
                continue
            fall = before - trial.cost(level)
            misfit = trial
            self._keep(around, misfit)
            if level == 0.0 and gain < min(settled * around.active.sum(), WHOLE):
                break
            again = level == 0.0 and damping == DAMPING and fall < SETTLING * before
            damping = max(DAMPING, 0.1 * damping)
            level = self._level(min(ANNEALING * level, misfit.strain))
        return around.active

    def _level(self, strain: float) -> float:
        """``strain``, or 0 where no loop edge is affected."""
        return strain if strain > self._config.loop_chi2 else 0.0

    def _around(
        self,
        counts: Mask,  # [M] edges
        active: Mask,  # [N] poses
        asked: Mask,  # [N] poses
    ) -> tuple[Neighbourhood, Misfit]:
        around = Neighbourhood(self._edges, counts, self._may_move, active, asked)
        if around.active.any():
            self._system = LinearSystem(around.local, around.active[around.nodes])
        poses, allowed = self.poses[around.nodes], self._allowed[around.used]
        return around, Misfit(poses, around.local, allowed, self._config.huber_sigmas)

    def _trial(
        self, around: Neighbourhood, at: Equations, level: float, damping: float | None
    ) -> tuple[Misfit | None, float]:
        """The state after a step, None if no step reduces the cost, and the predicted reduction.

        Without ``damping`` the last factor serves again. The promise is the square of the step's
        length in the metric of the information: shared out over the poses, it says how many
        standard deviations they move in the root mean square.
        """
        self.iterations += 1
        if damping is not None:
            self._system.factor(at, damping)
        step = self._system.step(at)
        if step is None:
            return None, np.inf
        gain = -float((step * at.gradient).sum())
        moving = np.flatnonzero(around.active[around.nodes])
        poses = at.misfit.poses
        limit = at.misfit.cost(level) * (1.0 + 1e-12) + 1e-12
        turn = float(np.abs(step[:, 3:]).max(initial=0.0))
        share = min(1.0, LARGEST_TURN / max(turn, LARGEST_TURN))
        for _ in range(SHORTENINGS):
            moved = (poses[moving] @ Sim3Batch.exp(share * step[moving])).on_group()
            if np.isfinite(moved.t).all() and (moved.scale > 0.0).all():
                trial = at.misfit.move(poses.replace(moving, moved))
                if trial.cost(level) <= limit:
                    self._system.note_step(share)
                    return trial, gain
            share *= SHORTER
        return None, np.inf

    def _keep(self, around: Neighbourhood, misfit: Misfit) -> None:
        moving = around.active[around.nodes]
        self.poses = self.poses.replace(around.nodes[moving], misfit.poses[moving])
