"""Poses and edges of a keyframe graph that an adjustment found better."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from aquaflow.tracking.graph.equations import Index, Mask, Rows, poses_of
from aquaflow.tracking.graph.table import EDGE, NODE, GraphResult, Snapshot, no_rows


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
