"""One optimisation of a snapshot: admit loops, descend, drop contradicted loops; repeat."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

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
    damping_of,
    poses_of,
    trust_of,
    wanted_moves,
)
from aquaflow.tracking.graph.loop_admission import Admission
from aquaflow.tracking.graph.table import GraphResult, Snapshot, write_poses

ROUNDS = 20
"""Most rounds in which loops that became plausible are tested again."""
LEAST_TRUST = 0.5
"""A loop with less trust than this after the descent is removed: chi2 of 3 phi."""


class Optimisation:
    """The state of one call of ``solve``."""

    def __init__(self, snapshot: Snapshot, everything: bool) -> None:
        self.snapshot, self.config = snapshot, snapshot.config
        nodes, self.edges = snapshot.nodes, snapshot.edges
        self.everything = everything
        self.links: Mask = nodes["number"][self.edges["a"]] >= 0
        """[M] edges between keyframes; the others come from a world, which all keyframes share: a
        chain through it would tell a loop nothing (``tracking/metric``)."""
        self.trust: Array = snapshot.trust["trust"].copy()
        self.allowed: Array = snapshot.trust["allowed"].copy()
        self.counts: Mask = self.trust > 0.0
        self.dropped: Mask = np.zeros(len(self.edges), dtype=bool)
        self.held: Mask = np.zeros(len(self.edges), dtype=bool)
        """[M] loops that would be dropped, if they did not join what nothing else joins."""
        may_move = nodes["number"] != nodes["component"]
        self.active: Mask = may_move if everything else np.zeros(len(nodes), dtype=bool)
        self.descent = Descent(poses_of(nodes), self.edges, self.allowed, may_move, self.config)

    def run(self) -> GraphResult:
        """Optimise."""
        fresh = np.arange(0 if self.everything else self.snapshot.settled, len(self.edges))
        fresh = np.union1d(self.snapshot.changed, fresh)
        asked = self._ends(self._strain(fresh[self.counts[fresh]]))
        candidates = self._candidates(fresh)
        for round_ in range(ROUNDS):
            counts = self.counts & self.links
            admission = Admission(self.descent.poses, self.edges, counts, self.config)
            new = admission.admit(candidates)
            self.counts[new.edges], self.trust[new.edges] = True, 1.0
            self.allowed[new.edges] = new.allowed
            asked |= new.quiet
            if not (len(new.edges) or asked.any() or (self.everything and round_ == 0)):
                break
            self.active = self.descent.run(self.counts, self.active | new.span, asked)
            asked = self._ends(self._update_trust())
            candidates = self._to_retest(candidates, bool(new.span.any()))
        return self._result()

    def _strain(
        self,
        edges: Index,  # [k] numbers of edges
    ) -> Index:
        """Those of ``edges`` that could move a pose by more than the tolerance."""
        return edges[self._misfit(edges).chi2 > self.config.tolerance_sigmas**2]

    def _misfit(
        self,
        edges: Index,  # [k] numbers of edges
    ) -> Misfit:
        rows, allowed = self.edges[edges], self.allowed[edges]
        return Misfit(self.descent.poses, rows, allowed, self.config.huber_sigmas)

    def _pending(self) -> Mask:
        return self.edges["loop"] & ~self.counts & ~self.dropped

    def _ends(
        self,
        edges: Index,  # [k] numbers of edges
    ) -> Mask:
        """[N] the poses at the ends of edges."""
        ends = np.zeros(len(self.snapshot.nodes), dtype=bool)
        ends[self.edges["a"][edges]] = ends[self.edges["b"][edges]] = True
        return ends

    def _candidates(
        self,
        fresh: Index,  # [k] numbers of edges
    ) -> Index:
        """Loops not yet admitted that are new, or that new ones may corroborate."""
        pending = np.flatnonzero(self._pending())
        new = np.intersect1d(pending, fresh)
        if len(new) == 0:
            return new
        near = np.ones((len(pending), len(new)), dtype=bool)
        for end in ("a", "b"):
            gap = np.subtract.outer(self.edges[end][pending], self.edges[end][new])
            near &= np.abs(gap) <= self.config.corroboration_window
        return pending[near.any(axis=1)]

    def _to_retest(
        self,
        candidates: Index,  # [k] numbers of edges
        closed: bool,
    ) -> Index:
        """Loops to test again: all if a loop closed, else the rest and those at moved poses."""
        pending = self._pending()
        if closed:
            return np.flatnonzero(pending)
        stirred = self.active[self.edges["a"]] | self.active[self.edges["b"]]
        stirred[candidates] = True
        return np.flatnonzero(pending & stirred)

    def _update_trust(self) -> Index:
        """Set the trust of the loops at active poses; remove those with too little."""
        ends = self.active[self.edges["a"]] | self.active[self.edges["b"]]
        loops = np.flatnonzero(self.edges["loop"] & self.counts & ends)
        if len(loops) == 0:
            return loops
        chi2 = self._misfit(loops).chi2
        self.trust[loops] = trust_of(chi2, self.allowed[loops])
        low = self.trust[loops] < LEAST_TRUST
        out = loops[low]
        ties = self._ties(out)
        held = out[ties]
        self.held[held], self.allowed[held], self.trust[held] = True, chi2[low][ties], 1.0
        away = out[~ties]
        self.trust[away], self.counts[away], self.dropped[away] = 0.0, False, True
        return out

    def _ties(
        self,
        loops: Index,  # [k] numbers of edges
    ) -> Mask:
        """[k] which of ``loops`` join keyframes that nothing else joins: without them a part of
        the dive would be free to go anywhere, so that the world may strain them, and not cut."""
        if not len(loops):
            return np.zeros(0, dtype=bool)
        others = self.counts & self.links
        others[loops] = False
        a, b = self.edges["a"][others], self.edges["b"][others]
        count = len(self.snapshot.nodes)
        joined = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
        _, part = connected_components(joined, directed=False)
        return np.asarray(part[self.edges["a"][loops]] != part[self.edges["b"][loops]])

    def _result(self) -> GraphResult:
        rows = np.flatnonzero(self.active)
        solved = self.snapshot.nodes[rows]
        write_poses(solved, slice(None), self.descent.poses[rows])
        touched = self.counts & (self.active[self.edges["a"]] | self.active[self.edges["b"]])
        after = self._misfit(np.flatnonzero(touched))
        before = after.move(poses_of(self.snapshot.nodes))
        poses, numbers = poses_of(solved), solved["number"].tolist()
        trust = self.snapshot.trust.copy()
        # Once other loops join the same keyframes, those held now are judged as all are.
        trust["trust"] = self.trust
        trust["allowed"] = np.where(self.held, trust["allowed"], self.allowed)
        return GraphResult(
            {number: poses.element(i) for i, number in enumerate(numbers)},
            {int(edge): float(self.trust[edge]) for edge in np.flatnonzero(self.edges["loop"])},
            self.descent.iterations,
            before.cost(),
            after.cost(),
            self.snapshot,
            rows,
            solved,
            trust,
        )


# --------------------------------------------------------------------------------------------------
# Sparse Levenberg-Marquardt over only those poses of a keyframe graph that move.
#
# The active set starts at what is new and grows, in doubling reach, while a pose at its rim would
# move by more than a tolerance.
#
# Why not ``optimise.minimise``: its problem has one set of unknowns and one cost, while here the
# set grows and the loops' kernel tightens (graduated non-convexity) on the way, and a factor serves
# several steps. Measured, a loop over 20 keyframes of a dive of 200 and of 1000, admission
# included: 17 and 20 ms of CPU time; the shared descent over all poses, without admission, 14 and
# 43 ms. A loop over all 1000: 86 and 60 ms, so that the shared one gains where everything moves,
# which is rare.

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


# --------------------------------------------------------------------------------------------------
# The sparse linear system of a pose graph: 7 x 7 blocks, factored by SuperLU (scipy).

MEMORY = 10
"""Number of past steps in the BFGS update."""


class LinearSystem:
    """Solves for the steps of the active poses; keeps its factor until :meth:`factor` is called.

    Steps after a factor's first are corrected by limited-memory BFGS (Nocedal, 1980), with the
    factor as the first guess of the Hessian: Gauss-Newton leaves out what bends the long soft
    modes of a graph, and alone takes dozens of factors to settle them.
    """

    def __init__(
        self,
        edges: Rows,  # [m]
        active: Mask,  # [n]
    ) -> None:
        self._active = active
        self._factor: SuperLU | None = None
        self._memory: list[tuple[Array, Array]] = []
        self._last: tuple[Array, Array] | None = None
        place = np.full(len(active), -1, dtype=np.intp)
        place[active] = np.arange(active.sum())
        a, b = place[edges["a"]], place[edges["b"]]
        self._both = (a >= 0) & (b >= 0)
        order = _ordering(a[self._both], b[self._both], int(active.sum()))
        self._a, self._b, self._own = order[a[self._both]], order[b[self._both]], order

    def factor(self, at: Equations, damping: float) -> None:
        """Factor the equations, damped by a share of their diagonal."""
        self._memory, self._last = [], None
        diagonal, links = at.diagonal[self._active], at.H_ab[self._both]
        own = diagonal + damping_of(diagonal, damping)[:, :, None] * np.eye(7)
        blocks = np.concatenate([own, links, links.transpose(0, 2, 1)])
        rows = np.concatenate([self._own, self._a, self._b])
        columns = np.concatenate([self._own, self._b, self._a])
        try:
            self._factor = splu(
                _assemble(blocks, rows, columns, len(self._own)),
                permc_spec="NATURAL",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:
            self._factor = None

    def step(self, at: Equations) -> Array | None:
        """[n, 7] step of all poses, zero for those that stay; None if the system is singular."""
        if self._factor is None:
            return None
        gradient = np.empty((len(self._own), 7))
        gradient[self._own] = at.gradient[self._active]
        solution = self._correct(self._factor, gradient.ravel())
        step = np.zeros((len(self._active), 7))
        step[self._active] = solution.reshape(-1, 7)[self._own]
        return step if np.isfinite(step).all() else None

    def note_step(self, share: float) -> None:
        """Record that the last step was taken, at a share of its length."""
        if self._last is not None:
            self._last = (share * self._last[0], self._last[1])

    def _correct(
        self,
        factor: SuperLU,
        gradient: Array,  # [n]
    ) -> Array:
        """The two-loop recursion of BFGS around the factor."""
        if self._last is not None:
            taken, before = self._last
            change = gradient - before
            if taken @ change > 0.0:
                self._memory = [*self._memory[1 - MEMORY :], (taken, change)]
        q, shares = gradient.copy(), []
        for taken, change in reversed(self._memory):
            shares.append(float(taken @ q) / float(taken @ change))
            q -= shares[-1] * change
        step = np.asarray(factor.solve(q))
        for taken, change in self._memory:
            step += (shares.pop() - float(change @ step) / float(taken @ change)) * taken
        self._last = (-step, gradient)
        return -step


def _ordering(
    a: Index,  # [m]
    b: Index,  # [m]
    count: int,
) -> Index:
    """[count] place of each block: minimum degree on the graph of blocks, so it costs little."""
    links = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
    graph = links + links.T
    dominant = sparse.diags(np.asarray(abs(graph).sum(axis=0)).ravel() + 1.0)
    factor = splu(
        sparse.csc_matrix(graph + dominant),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.asarray(factor.perm_c, dtype=np.intp)


def _assemble(
    blocks: Array,  # [B, 7, 7]
    rows: Index,  # [B] of blocks
    columns: Index,  # [B] of blocks
    count: int,
) -> sparse.csc_matrix:
    """Block-sparse symmetric matrix [7 count, 7 count]."""
    order = np.argsort(rows * count + columns, kind="stable")
    starts = np.searchsorted(rows[order], np.arange(count + 1))
    shape = (7 * count, 7 * count)
    matrix = sparse.bsr_matrix((blocks[order], columns[order], starts), shape=shape).tocsr()
    matrix.sum_duplicates()
    # Rows of a symmetric matrix are its columns: read as compressed columns, it is the same.
    return sparse.csc_matrix((matrix.data, matrix.indices, matrix.indptr), shape=shape)
