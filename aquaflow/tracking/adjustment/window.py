"""The problem of an adjustment, put together from anchored points, links and a snapshot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.tracking.adjustment.anchored_points import AnchoredPoints
from aquaflow.tracking.adjustment.equations import AnchorMatches, Array, Index, Mask
from aquaflow.tracking.adjustment.joint import JointAdjustmentResult, JointProblem
from aquaflow.tracking.adjustment.links import Links
from aquaflow.tracking.adjustment.uncertainty import covariance, of_edge
from aquaflow.tracking.graph.equations import poses_of
from aquaflow.tracking.graph.improvement import Improvement
from aquaflow.tracking.graph.table import Snapshot, write_poses

KNOWN_SIGMA = 0.15
"""Relative: a depth that the pointmap knows worse says nothing."""
LEAST_SIGMA = 1e-6
"""Of an edge, in its units: keeps the information finite."""


@dataclass(frozen=True)
class MeasuredLink:
    """What tracking measured between a keyframe and the one before it, as an edge of the graph."""

    parent: int
    T_ab: Sim3
    information: Array
    """[7, 7]"""


def problem_of(
    numbers: Sequence[int],
    points: Mapping[int, AnchoredPoints],
    links: Mapping[int, MeasuredLink],
    poses: Sim3Batch,  # [K] of ``numbers``
    held: Mask,  # [K]
) -> JointProblem:
    """Everything that is known between the keyframes ``numbers``."""
    place = {number: i for i, number in enumerate(numbers)}
    anchors = [points[number] for number in numbers if number in points]
    matches = [_matches_of(each, place) for each in anchors]
    inside = [n for n in numbers if n in links and links[n].parent in place]
    return JointProblem(
        matches,
        [each.held_out for each in anchors],
        Links(
            np.array([place[n] for n in inside], dtype=np.intp),
            np.array([place[links[n].parent] for n in inside], dtype=np.intp),
            Sim3Batch.of([links[n].T_ab for n in inside] or [Sim3.identity()])[: len(inside)],
            np.array([links[n].information for n in inside]).reshape(-1, 7, 7),
        ),
        poses,
        ~held,
    )


def _matches_of(points: AnchoredPoints, place: Mapping[int, int]) -> AnchorMatches:
    views = [number for number in sorted(points.seen) if number in place]
    at = np.zeros((len(views), len(points.rho), 2), np.float32)
    for i, number in enumerate(views):
        at[i] = points.seen[number]
    rho, variance = points.rho.astype(np.float64), points.variance.astype(np.float64)
    known = (rho > 1e-6) & (variance < (KNOWN_SIGMA * rho) ** 2)
    usual = float(np.median(rho[known])) if known.any() else 1.0
    return AnchorMatches(
        place[points.keyframe],
        np.array([place[number] for number in views], dtype=np.intp),
        points.rays,
        np.where(known, rho, usual),
        np.where(known, variance, np.inf),
        at,
        np.asarray(np.isfinite(at).all(axis=-1)),
        np.full(len(views), 1.0 / points.camera.fx),
    )


def improvement_of(
    snapshot: Snapshot,
    nodes: Index,  # [K] rows of the adjusted keyframes
    problem: JointProblem,
    adjusted: JointAdjustmentResult,
    certain: bool,
) -> Improvement:
    """The adjustment's poses, and the edges between them; ``certain``: with their covariance.

    Raises:
        numpy.linalg.LinAlgError: a pose is not determined at all.
    """
    place = np.full(len(snapshot.nodes), -1, dtype=np.intp)
    place[nodes] = np.arange(len(nodes))
    a, b = place[snapshot.edges["a"]], place[snapshot.edges["b"]]
    among = (a >= 0) & (b >= 0) & ~snapshot.edges["loop"]
    among[among] = _is_linked(a[among], b[among], problem.links)
    edges = np.flatnonzero(among)
    poses, moved = adjusted.state.poses, problem.free
    rows = snapshot.edges[edges]
    T_ab = (poses[a[edges]].inverse() @ poses[b[edges]]).on_group()
    write_poses(rows, slice(None), T_ab)
    if certain and len(edges):
        inverse = covariance(adjusted.matches, problem.links, adjusted.state, moved)
        order = np.where(moved, np.cumsum(moved) - 1, -1)
        for i, edge in enumerate(edges):
            spread = of_edge(inverse, order, int(a[edge]), int(b[edge]), T_ab[i : i + 1])
            spread = spread + LEAST_SIGMA**2 * np.eye(7)
            rows["covariance"][i], rows["information"][i] = spread, np.linalg.inv(spread)
    node_rows = snapshot.nodes[nodes[moved]]
    write_poses(node_rows, slice(None), poses[moved])
    return Improvement(nodes[moved], node_rows, edges, rows)


def _is_linked(
    a: Index,  # [m] places
    b: Index,  # [m]
    links: Links,
) -> Mask:
    """[m] the edges that are links of the problem."""
    known = set(zip(links.a.tolist(), links.b.tolist(), strict=True))
    pairs = zip(a.tolist(), b.tolist(), strict=True)
    return np.array([pair in known for pair in pairs], dtype=bool)


def poses_at(
    snapshot: Snapshot,
    nodes: Index,  # [K]
) -> Sim3Batch:
    """[K] poses in rows ``nodes`` [K] of a snapshot."""
    return poses_of(snapshot.nodes[nodes])


def copy(points: AnchoredPoints) -> AnchoredPoints:
    """A copy that another thread may add to; the arrays are shared, and never change."""
    return replace(points, seen=dict(points.seen))
