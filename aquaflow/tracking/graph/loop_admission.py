"""Admission of loop edges: each is tested against the chain of edges that it would bend.

A robust weight alone cannot detect a false loop: a long soft chain bends to it until its residual
is small. So before an edge counts, its relative pose is compared with the present estimate in the
metric of its own covariance plus that of the chain between its ends (individual compatibility,
Neira and Tardos 2001), the chain's grown by how much worse than stated tracking may drift. Edges
that close the same loop from other keyframes corroborate each other and are allowed more drift.
What is not admitted keeps trust zero and is tested again when the map around it has changed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.tracking.graph.equations import Array, Index, Mask, Rows, poses_of, residuals

WITNESSES = 8
"""Other loop edges, the nearest first, that are tested for agreement with one."""
CORROBORATION = 2
"""Other loop edges that must agree with one for it to count as corroborated."""


@dataclass
class Chains:
    """Shortest chains of counted edges between poses, and how uncertain they are."""

    poses: Sim3Batch
    """[N]"""
    edges: Rows
    """[M]"""
    counted: Index
    """Which edges count."""
    trees: dict[int, Index] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.poses)
        a, b = self.edges["a"][self.counted], self.edges["b"][self.counted]
        self.keys = np.concatenate([a * n + b, b * n + a])
        self.order = np.argsort(self.keys, kind="stable")
        data = np.ones(2 * len(a))
        ends = (np.concatenate([a, b]), np.concatenate([b, a]))
        # Carried into the world, where the covariances of a chain's links add up; as needed.
        self.world = np.empty((len(self.edges), 7, 7))
        self.in_world = np.zeros(len(self.edges), dtype=bool)
        self.links = sparse.csr_matrix((data, ends), shape=(n, n))

    def path(self, a: int, b: int) -> Index:
        """Poses from ``a`` to ``b``, both included; only ``b`` if no chain joins them."""
        if a not in self.trees:
            tree = breadth_first_order(self.links, a, directed=True)[1]
            self.trees[a] = np.asarray(tree, dtype=np.intp)
        before, path = self.trees[a], [b]
        while path[-1] != a and before[path[-1]] >= 0:
            path.append(int(before[path[-1]]))
        return np.array(path[::-1], dtype=np.intp)

    def covariance(
        self,
        path: Index,  # [k] numbers of poses
    ) -> Array:
        """[7, 7] of the pose of the path's end seen from its start, in the tangent of the end."""
        if len(path) < 2:
            return np.zeros((7, 7))
        wanted = path[:-1] * len(self.poses) + path[1:]
        found = self.order[np.searchsorted(self.keys, wanted, sorter=self.order)]
        along = self.counted[found % len(self.counted)]
        missing = np.unique(along[~self.in_world[along]])
        if len(missing):
            edges = self.edges[missing]
            Ad = self.poses[edges["b"]].adjoint()
            self.world[missing] = Ad @ edges["covariance"] @ Ad.transpose(0, 2, 1)
            self.in_world[missing] = True
        Ad = self.poses[path[-1:]].inverse().adjoint()[0]
        return np.asarray(Ad @ self.world[along].sum(axis=0) @ Ad.T)


class LoopTest:
    """A loop edge against the chain between its ends."""

    def __init__(
        self,
        loop: Rows,  # [] EDGE
        r: Array,  # [7]
        chains: Chains,
    ) -> None:
        self.loop, self.r, self.chains = loop, r, chains

    @cached_property
    def path(self) -> Index:
        """The poses of the chain."""
        return self.chains.path(int(self.loop["a"]), int(self.loop["b"]))

    @cached_property
    def chain(self) -> Array:
        """[7, 7] covariance of the chain."""
        return self.chains.covariance(self.path)

    def stretch(self, drift: float) -> float:
        """chi2 of closing the loop if the chain drifts ``drift`` times worse than stated."""
        return _chi2(self.r, self.loop["covariance"] + drift**2 * self.chain)


@dataclass(frozen=True)
class Admitted:
    """The loops that count from now on."""

    edges: Index
    """[k]"""
    allowed: Array
    """[k] phi of each: the squared residual that it may keep at full trust."""
    span: Mask
    """[N] poses on the chains that they bend."""
    quiet: Mask
    """[N] poses at the ends of those that agree with the estimate as it is."""


@dataclass
class Admission:
    """Decides about candidates among ``edges``, given those that ``count`` already."""

    poses: Sim3Batch
    """[N]"""
    edges: Rows
    """[M]"""
    counts: Mask
    """[M]"""
    config: GraphConfig

    def admit(
        self,
        candidates: Index,  # [k] numbers of edges
    ) -> Admitted:
        """The most certain candidates; call again when these loops have closed."""
        config, loops = self.config, self.edges[candidates]
        span, quiet = np.zeros((2, len(self.poses)), dtype=bool)
        r, _ = residuals(self.poses, loops)
        allowed = np.full(len(loops), config.loop_chi2)
        accepted = np.array(
            [_chi2(r[i], loops["covariance"][i]) <= config.loop_chi2 for i in range(len(loops))],
            dtype=bool,
        )
        quiet[loops["a"][accepted]] = quiet[loops["b"][accepted]] = True
        if accepted.all():
            return Admitted(candidates, allowed, span, quiet)
        chains = Chains(self.poses, self.edges, np.flatnonzero(self.counts))
        tests = [LoopTest(loops[i], r[i], chains) for i in range(len(loops))]
        doubtful = np.flatnonzero(~accepted)
        # The most certain first: closing them separates true from false among the others.
        for drift, alone in (
            (1.0, True),
            (config.corroborated_drift_factor, False),
            (config.drift_factor, True),
        ):
            if drift > 1.0 and accepted.any():
                break
            for i in doubtful:
                if tests[i].stretch(drift) <= config.loop_chi2:
                    accepted[i] = alone or self._is_corroborated(loops, int(i), chains)
        for i in doubtful[accepted[doubtful]]:
            # The loop may have to balance the chain's strain alone.
            allowed[i] = max(config.loop_chi2, tests[i].stretch(1.0))
            span[tests[i].path] = True
        return Admitted(candidates[accepted], allowed[accepted], span, quiet)

    def _is_corroborated(
        self,
        loops: Rows,  # [k] EDGE
        i: int,
        chains: Chains,
    ) -> bool:
        """True if enough others agree with loop ``i``, from other keyframes."""
        config = self.config
        far_a, far_b = abs(loops["a"] - loops["a"][i]), abs(loops["b"] - loops["b"][i])
        near = (far_a <= config.corroboration_window) & (far_b <= config.corroboration_window)
        others = np.flatnonzero(near & (far_a > 0) & (far_b > 0))
        nearest = others[np.argsort((far_a + far_b)[others], kind="stable")]
        votes = 0
        for j in nearest[:WITNESSES]:
            pair = loops[[j, i]]
            ends = self.poses[pair["a"]], self.poses[pair["b"]]
            votes += gap_chi2(pair, *ends, chains, config) <= config.loop_chi2
            if votes >= CORROBORATION:
                return True
        return False


def gap_chi2(
    pair: Rows,  # [2] EDGE
    at: Sim3Batch,  # [2] poses of their a
    seen: Sim3Batch,  # [2] poses of their b
    chains: Chains,
    config: GraphConfig,
) -> float:
    """chi2 of the difference between two loops, seen from the second loop's b."""
    claimed = at @ poses_of(pair)
    T_ji = seen[:1].inverse() @ seen[1:]
    gap = (claimed[1:].inverse() @ (claimed[:1] @ T_ji)).log()[0]
    back = T_ji.inverse().adjoint()[0]
    ahead = (seen[1:].inverse() @ at[1:]).adjoint()[0]
    at_b = chains.covariance(chains.path(int(pair["b"][0]), int(pair["b"][1])))
    at_a = chains.covariance(chains.path(int(pair["a"][0]), int(pair["a"][1])))
    own = pair["covariance"][1] + back @ pair["covariance"][0] @ back.T
    between = at_b + ahead @ at_a @ ahead.T
    return _chi2(gap, own + config.drift_factor**2 * between)


def _chi2(
    r: Array,  # [7]
    covariance: Array,  # [7, 7]
) -> float:
    return float(r @ np.linalg.solve(covariance, r))
