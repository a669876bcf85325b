"""Rows of a keyframe graph: append-only arrays that a snapshot can share without a copy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.tracking.graph.equations import Index, Mask, Rows, poses_of

_SIM3 = [("R", np.float64, (3, 3)), ("t", np.float64, 3), ("scale", np.float64)]
"""Columns of a similarity."""

NODE = np.dtype([("number", np.int64), ("component", np.int64), *_SIM3])
"""A keyframe: its number, that of the first keyframe of its component, T_wc."""

EDGE = np.dtype(
    [
        ("a", np.intp),
        ("b", np.intp),
        *_SIM3,
        ("information", np.float64, (7, 7)),
        ("covariance", np.float64, (7, 7)),
        ("loop", np.bool_),
    ]
)
"""An edge: rows of its two keyframes and T_ab."""

TRUST = np.dtype([("trust", np.float64), ("allowed", np.float64)])
"""Switch variable of an edge, 0 for a loop that is not (yet) admitted; and its phi, the squared
residual that a loop may keep at full trust."""

LEAST_ROWS = 16
"""Of a buffer."""

ROUNDING = 1e-9
"""Smallest move, in m, rad and log-scale, that counts as one."""


class Table:
    """Rows that only ever grow: views handed out earlier never change."""

    def __init__(self, dtype: np.dtype[np.void]) -> None:
        self._buffer: Rows = np.zeros(LEAST_ROWS, dtype=dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, **values: object) -> None:
        """Append one row, given by field."""
        if self._count == len(self._buffer):
            grown = np.zeros(max(2 * self._count, LEAST_ROWS), dtype=self._buffer.dtype)
            grown[: self._count] = self._buffer
            self._buffer = grown
        for name, value in values.items():
            self._buffer[name][self._count] = value
        self._count += 1

    @property
    def rows(self) -> Rows:
        """Read-only view of all rows."""
        view = self._buffer[: self._count]
        view.flags.writeable = False
        return view

    def unseen(self, first: int) -> Rows:
        """Writable view of the rows from ``first`` on, which no view handed out may hold."""
        return self._buffer[first : self._count]

    def replace(
        self,
        rows: Rows,  # [n] of the table's dtype
    ) -> None:
        """Replace the contents of all rows; views returned before keep the old ones."""
        self._buffer = rows
        self._count = len(rows)


def no_rows() -> Index:
    """[0] of a table."""
    return np.zeros(0, dtype=np.intp)


@dataclass(frozen=True)
class Snapshot:
    """A keyframe graph at one moment: read-only, so that another thread may work on it."""

    nodes: Rows
    """[N] NODE"""
    edges: Rows
    """[M] EDGE"""
    trust: Rows
    """[M] TRUST"""
    joins: int
    """Components that had been joined since the last result was applied."""
    settled: int
    """Edges before this one were there at the last optimisation."""
    version: int
    """How many results had been applied."""
    config: GraphConfig
    changed: Index = field(default_factory=no_rows)
    """Older edges that are to be looked at again: an adjustment changed them or their poses."""


@dataclass(frozen=True)
class GraphResult:
    """The result of an optimisation."""

    poses: Mapping[int, Sim3]
    """New T_wc by keyframe number, of those that moved only."""
    trust: Mapping[int, float]
    """Switch variable in [0, 1] of every loop edge, by its place among all edges added."""
    iterations: int
    cost_before: float
    """Robust cost of all edges of the optimisation; loops not admitted add nothing."""
    cost_after: float
    snapshot: Snapshot
    rows: Index
    """[k] nodes of the snapshot that were solved."""
    solved: Rows
    """[k] NODE, with their new poses."""
    edge_trust: Rows
    """[M] TRUST"""
    better: Index = field(default_factory=no_rows)
    """[b] edges that an adjustment found better values for."""
    better_edges: Rows = field(default_factory=lambda: np.zeros(0, EDGE))
    """[b] EDGE"""
    pending: Index = field(default_factory=no_rows)
    """Edges for the next optimisation to look at, as ``Snapshot.changed``."""


def write_poses(
    rows: Rows,  # [n] NODE or EDGE
    where: Index | Mask | slice,  # [k] numbers or [n] bool
    poses: Sim3Batch,
) -> None:
    """Write similarities into NODE or EDGE rows, in place."""
    rows["R"][where], rows["t"][where], rows["scale"][where] = poses.R, poses.t, poses.scale


@dataclass(frozen=True)
class Join:
    """A component that became part of another: its poses went to S @ T."""

    moved: int
    into: int
    S: Sim3Batch
    """[1]"""

    @property
    def still(self) -> bool:
        """True if S is the identity, except for rounding."""
        return bool(np.abs(self.S.log()).max() < ROUNDING)

    def apply(
        self,
        nodes: Rows,  # [N] NODE
    ) -> Index:
        """Move the component's nodes into the frame of the other, in place; which they were."""
        rows = np.flatnonzero(nodes["component"] == self.moved)
        if not self.still:
            write_poses(nodes, rows, (self.S @ poses_of(nodes[rows])).on_group())
        nodes["component"][rows] = self.into
        return rows


# --------------------------------------------------------------------------------------------------
# Poses and edges of a keyframe graph that an adjustment found better.


@dataclass(frozen=True)
class Improvement:
    """Rows of a snapshot, and what they should be."""

    nodes: Index
    """[n]"""
    node_rows: Rows
    """[n] NODE"""
    edges: Index
    """[e]"""
    edge_rows: Rows
    """[e] EDGE"""

    @staticmethod
    def none() -> Improvement:
        """Nothing is better."""
        return Improvement(no_rows(), np.zeros(0, NODE), no_rows(), np.zeros(0, EDGE))

    def of(self, snapshot: Snapshot) -> Snapshot:
        """The snapshot with the better poses and edges in place."""
        if not len(self.nodes) and not len(self.edges):
            return snapshot
        nodes, edges = snapshot.nodes.copy(), snapshot.edges.copy()
        nodes[self.nodes], edges[self.edges] = self.node_rows, self.edge_rows
        moved: Mask = np.zeros(len(nodes), dtype=bool)
        moved[self.nodes] = True
        touched = np.flatnonzero(moved[edges["a"]] | moved[edges["b"]])
        changed = np.union1d(np.union1d(snapshot.changed, touched), self.edges)
        return replace(snapshot, nodes=nodes, edges=edges, changed=changed)

    def alone(self, snapshot: Snapshot) -> GraphResult:
        """A result of these poses and edges; the optimisation is left to a later snapshot."""
        pending = self.of(snapshot).changed
        settled = np.arange(snapshot.settled, len(snapshot.edges))
        nothing = GraphResult(
            {}, {}, 0, 0.0, 0.0, snapshot, no_rows(), snapshot.nodes[:0], snapshot.trust
        )
        return replace(self.within(nothing, snapshot), pending=np.union1d(pending, settled))

    def within(self, result: GraphResult, snapshot: Snapshot) -> GraphResult:
        """``result`` of the improved snapshot as one of ``snapshot``: poses that it left where the
        adjustment put them are among its poses."""
        left = np.isin(self.nodes, result.rows, invert=True)
        rows = self.node_rows[left]
        poses = poses_of(rows)
        found = {int(number): poses.element(i) for i, number in enumerate(rows["number"])}
        return replace(
            result,
            poses=dict(result.poses) | found,
            snapshot=snapshot,
            rows=np.concatenate([result.rows, self.nodes[left]]),
            solved=np.concatenate([result.solved, rows]),
            better=self.edges,
            better_edges=self.edge_rows,
        )
