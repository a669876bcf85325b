"""The keyframe graph: Sim(3) edges between keyframes, optimised in parallel to tracking.

``snapshot()`` -> ``solve(snapshot)`` -> ``apply(result)``: solving is a pure function, so the
pipeline runs it in a thread, or inline where a replay must be the same each time. ``optimise``
does the three in one go.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.tracking.graph.equations import Array, Rows, chi_squares, poses_of, residuals
from aquaflow.tracking.graph.optimisation import Optimisation
from aquaflow.tracking.graph.table import (
    EDGE,
    NODE,
    TRUST,
    GraphResult,
    Join,
    Snapshot,
    Table,
    no_rows,
    write_poses,
)

UNKNOWN_SIGMA = 1e3
"""Standard deviation of an unknown direction of an edge."""
LEAST_SIGMA = 1e-6
"""Least standard deviation of an edge: keeps the equations solvable."""


@dataclass(frozen=True)
class Edge:
    """A measured relative pose of two keyframes."""

    a: int
    b: int
    """Keyframe numbers."""
    T_ab: Sim3
    information: Array
    """[7, 7] of the right tangent, T_ab exp(d), in b's frame; see ``edge_information``."""
    loop: bool = False
    """True for a loop edge, which may be false and is switched off if the other edges contradict
    it."""


def edge_information(
    covariance: Array,  # [6, 6]
    scale_sigma: float,
    T_ab: Sim3,
) -> Array:
    """Information [7, 7] of an edge whose pose was solved and whose scale is known separately.

    ``covariance`` is of the left tangent of ``T_ab``, [translation, rotation], as the pose solver
    gives it; it is carried over into b's frame. ``scale_sigma`` is the standard deviation of the
    log of b's scale over a's.
    """
    carried = Sim3Batch.of([T_ab.inverse()]).adjoint()[0][:, :6]
    whole = carried @ covariance @ carried.T
    whole[6, 6] += scale_sigma**2
    return _information_and_covariance(np.linalg.pinv(whole, hermitian=True))[0]


def _information_and_covariance(
    information: Array,  # [7, 7]
) -> tuple[Array, Array]:
    """The nearest positive semi-definite information, and its inverse with unknowns bounded."""
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    values = np.clip(values, 0.0, LEAST_SIGMA**-2)
    inverse = 1.0 / np.maximum(values, UNKNOWN_SIGMA**-2)
    return (vectors * values) @ vectors.T, (vectors * inverse) @ vectors.T


class PoseGraph:
    """Keyframes and edges; one thread adds and applies, any thread may solve a snapshot."""

    def __init__(self, config: GraphConfig | None = None) -> None:
        self.config = config or GraphConfig()
        self.refused: Counter[str] = Counter()
        """Keyframes and edges that were not taken, by reason."""
        self._nodes = Table(NODE)
        self._edges = Table(EDGE)
        self._trust = Table(TRUST)
        self._row: dict[int, int] = {}
        self._settled = 0
        self._version = 0
        self._joins: list[Join] = []
        self._shifted: set[int] = set()
        self._members: Counter[int] = Counter()
        self._seen = 0
        self._changed = no_rows()

    def __contains__(self, number: int) -> bool:
        return number in self._row

    def tables(self) -> dict[str, Rows]:
        """All keyframes and edges, for a file: read-only, and never changed later."""
        self._seen = len(self._nodes)
        return {"nodes": self._nodes.rows, "edges": self._edges.rows, "trust": self._trust.rows}

    @classmethod
    def of_tables(
        cls,
        tables: Mapping[str, Rows],  # as from tables
        config: GraphConfig,
        settled: int = 0,
    ) -> PoseGraph:
        """The graph of ``tables``; every edge from ``settled`` on counts as new for the next
        optimisation."""
        graph = cls(config)
        for table, rows in (
            (graph._nodes, tables["nodes"].astype(NODE)),
            (graph._edges, tables["edges"].astype(EDGE)),
            (graph._trust, tables["trust"].astype(TRUST)),
        ):
            if len(rows):
                table.replace(rows)
        graph._row = {int(number): row for row, number in enumerate(graph._nodes.rows["number"])}
        graph._members = Counter(graph._nodes.rows["component"].tolist())
        graph._settled = settled
        graph._seen = len(graph._nodes)
        return graph

    def add_keyframe(self, number: int, T_wc: Sim3) -> bool:
        """Add a keyframe, a component of its own until an edge joins it. False if it was
        refused."""
        if number in self._row:
            return self._refuse("keyframe is there already")
        if not T_wc.is_finite():
            return self._refuse("keyframe pose is not finite")
        self._row[number] = len(self._nodes)
        self._members[number] = 1
        self._nodes.append(number=number, component=number, R=T_wc.R, t=T_wc.t, scale=T_wc.scale)
        return True

    def add_edge(self, edge: Edge) -> bool:
        """Add an edge between two known keyframes. False if it was refused.

        An edge between two components moves the later one, as a whole, to where it says.
        """
        if edge.a == edge.b or edge.a not in self._row or edge.b not in self._row:
            return self._refuse("edge needs two different known keyframes")
        if not edge.T_ab.is_finite():
            return self._refuse("edge pose is not finite")
        information = np.asarray(edge.information, dtype=np.float64)
        if information.shape != (7, 7) or not np.isfinite(information).all():
            return self._refuse("edge information is not finite")
        information, covariance = _information_and_covariance(information)
        if not information.any():
            return self._refuse("edge information is empty")
        joins = self.component_of(edge.a) != self.component_of(edge.b)
        self._edges.append(
            a=self._row[edge.a],
            b=self._row[edge.b],
            R=edge.T_ab.R,
            t=edge.T_ab.t,
            scale=edge.T_ab.scale,
            information=information,
            covariance=covariance,
            loop=edge.loop,
        )
        self._trust.append(trust=float(joins or not edge.loop), allowed=self.config.loop_chi2)
        if joins:
            self._join(edge)
        return True

    def pose(self, number: int) -> Sim3:
        """T_wc of a keyframe as the graph has it now."""
        return self._poses(number).element(0)

    def _poses(self, number: int) -> Sim3Batch:
        row = self._row[number]
        return poses_of(self._nodes.rows[row : row + 1])

    def newest_agrees(self) -> bool:
        """True if the newest edge is a loop within one component, and its keyframes are where it
        says, within the squared residual that a loop may keep at full trust."""
        edge, trust = self._edges.rows[-1:], self._trust.rows[-1]
        r, _ = residuals(poses_of(self._nodes.rows), edge)
        return bool(trust["trust"] == 0.0 and chi_squares(r, edge)[0] <= trust["allowed"])

    def component_of(self, number: int) -> int:
        """The first keyframe of the component that a keyframe belongs to."""
        return int(self._nodes.rows["component"][self._row[number]])

    def move_component(self, number: int, S: Sim3) -> None:
        """Take the component of keyframe ``number`` by ``S`` to another world, in which that
        keyframe is the one that stays. Not while a snapshot is being solved."""
        nodes, before = self._nodes.rows.copy(), self.component_of(number)
        rows = np.flatnonzero(nodes["component"] == before)
        write_poses(nodes, rows, (Sim3Batch.of([S]) @ poses_of(nodes[rows])).on_group())
        nodes["component"][rows] = number
        self._nodes.replace(nodes)
        self._members[number] = self._members.pop(before)

    def snapshot(self) -> Snapshot:
        """The graph's current state, to be solved in any thread; no copy is made."""
        self._seen = len(self._nodes)
        return Snapshot(
            self._nodes.rows,
            self._edges.rows,
            self._trust.rows,
            len(self._joins),
            self._settled,
            self._version,
            self.config,
            self._changed,
        )

    def optimise(self, everything: bool = False) -> GraphResult:
        """Solve and apply at once; ``everything``: as if all edges were new."""
        result = solve(self.snapshot(), everything)
        return self.apply(result) or result

    def apply(self, result: GraphResult) -> GraphResult | None:
        """Apply a result; None, and no change, if another was applied since its snapshot.

        Keyframes added meanwhile go along with the keyframe before them, as one body. The answer's
        ``poses`` holds these too, and those that a join of components moved.

        Raises:
            ArithmeticError: a pose of the result is not finite; nothing is taken over then.
        """
        if result.snapshot.version != self._version:
            return None
        numbers = set(result.poses) | self._shifted
        if len(result.rows):
            solved = result.solved.copy()
            for join in self._joins[result.snapshot.joins :]:
                join.apply(solved)
            nodes = self._nodes.rows.copy()
            nodes[result.rows] = solved
            numbers |= self._carry(nodes, result)
            if not all(np.isfinite(nodes[name]).all() for name in ("R", "t", "scale")):
                raise ArithmeticError("an optimised pose is not finite")
            self._nodes.replace(nodes)
        trust = self._trust.rows.copy()
        trust[: len(result.edge_trust)] = result.edge_trust
        self._trust.replace(trust)
        if len(result.better):
            edges = self._edges.rows.copy()
            edges[result.better] = result.better_edges
            self._edges.replace(edges)
        self._settled, self._changed = len(result.edge_trust), result.pending
        self._version += 1
        self._joins, self._shifted = [], set()
        ordered = sorted(numbers)
        poses = poses_of(self._nodes.rows[[self._row[number] for number in ordered]])
        found = {number: poses.element(i) for i, number in enumerate(ordered)}
        return replace(result, poses=found)

    def _carry(
        self,
        nodes: Rows,  # [N] NODE, changed in place
        result: GraphResult,
    ) -> set[int]:
        """Move keyframes that are newer than a result with the one before them, in place."""
        before, count = self._nodes.rows, len(result.snapshot.nodes)
        solved = np.zeros(count, dtype=bool)
        solved[result.rows] = True
        carried = set()
        for row in range(count, len(nodes)):
            same = nodes["component"][:count] == nodes["component"][row]
            earlier = same & (nodes["number"][:count] < nodes["number"][row])
            guide = int(np.argmax(np.where(earlier, nodes["number"][:count], -1)))
            if not (earlier[guide] and solved[guide]):
                continue
            guided, own = slice(guide, guide + 1), slice(row, row + 1)
            change = poses_of(nodes[guided]) @ poses_of(before[guided]).inverse()
            write_poses(nodes, own, (change @ poses_of(nodes[own])).on_group())
            carried.add(int(nodes["number"][row]))
        return carried

    def _join(self, edge: Edge) -> None:
        """Move the later of the edge's two components so that the edge is satisfied."""
        at_a, at_b = self.component_of(edge.a), self.component_of(edge.b)
        T_wa, T_wb = (self._poses(number) for number in (edge.a, edge.b))
        S = T_wa @ Sim3Batch.of([edge.T_ab]) @ T_wb.inverse()
        join = Join(at_b, at_a, S) if at_a < at_b else Join(at_a, at_b, S.inverse())
        new = self._row[join.moved]
        alone = self._members[join.moved] == 1 and new >= self._seen
        # A keyframe that no snapshot contains yet, the usual case, is changed in place.
        nodes = self._nodes.unseen(new) if alone else self._nodes.rows.copy()
        rows = join.apply(nodes)
        if not join.still:
            self._shifted |= {int(number) for number in nodes["number"][rows]}
        if not alone:
            self._nodes.replace(nodes)
            self._joins.append(join)
        self._members[join.into] += self._members.pop(join.moved)

    def _refuse(self, reason: str) -> bool:
        self.refused[reason] += 1
        return False


def solve(snapshot: Snapshot, everything: bool = False) -> GraphResult:
    """Optimise a snapshot; reads nothing else and changes nothing.

    The work grows with what changed since the last result: the edges added, the chains that their
    loops bend, and the poses that this moves by more than the tolerance. With ``everything`` all
    poses are solved.
    """
    return Optimisation(snapshot, everything).run()
