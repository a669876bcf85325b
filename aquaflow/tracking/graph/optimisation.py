"""One optimisation of a snapshot: admit loops, descend, drop contradicted loops; repeat."""

from __future__ import annotations

import numpy as np

from aquaflow.tracking.graph.descent import Descent
from aquaflow.tracking.graph.equations import (
    Array,
    Index,
    Mask,
    Misfit,
    poses_of,
    trust_of,
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
        self.trust[loops] = trust_of(self._misfit(loops).chi2, self.allowed[loops])
        out = loops[self.trust[loops] < LEAST_TRUST]
        self.trust[out], self.counts[out], self.dropped[out] = 0.0, False, True
        return out

    def _result(self) -> GraphResult:
        rows = np.flatnonzero(self.active)
        solved = self.snapshot.nodes[rows]
        write_poses(solved, slice(None), self.descent.poses[rows])
        touched = self.counts & (self.active[self.edges["a"]] | self.active[self.edges["b"]])
        after = self._misfit(np.flatnonzero(touched))
        before = after.move(poses_of(self.snapshot.nodes))
        poses, numbers = poses_of(solved), solved["number"].tolist()
        trust = self.snapshot.trust.copy()
        trust["trust"], trust["allowed"] = self.trust, self.allowed
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
