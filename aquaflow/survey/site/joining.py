"""Links between dives in their joint graph: those that agree join sub-maps; all is optimised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import numpy.typing as npt

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.survey.site.joint_graph import (
    AGAINST_GRAPH,
    AGAINST_OTHERS,
    ALONE,
    JOINT_LINK,
    LEAST_TRUST,
    USED,
    JointGraph,
)
from aquaflow.survey.site.links import DiveLinks
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.graph.loop_admission import Chains
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph, solve

GROWN = 1.1
"""Keyframes over those there were, at which all are optimised together again: what that costs grows
with their number, and so costs each dive the same. Between, a dive that is added moves no other:
the 31st to 34th over one reef would move them by 0.2 to 3 mm, at 1.6 m from the ground
(notes/2026-11-sites.md#hundred)."""

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]


def links_of(joint: JointGraph, dive: str, links: DiveLinks) -> Rows:
    """[n] JOINT_LINK: what looking up ``dive`` found in dives of the graph; fingerprints."""
    number = {fingerprint: index for index, fingerprint in enumerate(joint.dives)}
    own, there = number[dive], [number.get(each, -1) for each in links.among]
    found = links.rows[np.array(there, int)[links.rows["dive"]] >= 0]
    rows = np.zeros(len(found), JOINT_LINK)
    for name in found.dtype.names or ():
        if name != "dive":
            rows[name] = found[name]
    rows["node_a"] = [joint.node(there[row["dive"]], int(row["a"])) for row in found]
    rows["node_b"] = [joint.node(own, int(row["b"])) for row in found]
    rows["edge"], rows["verdict"] = -1, ALONE
    return rows


def join(
    joint: JointGraph,
    links: Rows,  # [n] JOINT_LINK
) -> None:
    """Join the components that agreeing links connect, those of earlier dives that nothing agreed
    with among them, and optimise what that moves."""
    joint.links = np.concatenate([joint.links, links])
    components = len(joint.components())
    while True:
        # The best proved first: an edge that joins two components is tested by nothing else.
        found = [_compare(joint, numbers) for numbers in _between_components(joint)]
        best = max(found, key=lambda each: len(each.kept), default=_Comparison())
        if not len(best.kept):
            break
        _add(joint, best.kept)
        joint.links["verdict"][best.against] = AGAINST_OTHERS
    _add(joint, _open(joint)[0])
    _optimise(joint, whole=len(joint.components()) < components - 1)
    judged = joint.links["edge"] >= 0
    trust = joint.graph.tables()["trust"]["trust"][joint.links["edge"][judged]]
    joint.links["verdict"][judged] = np.where(trust >= LEAST_TRUST, USED, AGAINST_GRAPH)
    joint.settle_worlds()
    joint.show()


def _optimise(joint: JointGraph, whole: bool) -> None:
    """Move the last dive to where its links say; and all others, if ``whole`` or if the site has
    grown by ``GROWN`` since that was done last."""
    snapshot = joint.graph.snapshot()
    nodes, edges = snapshot.nodes, len(snapshot.edges)
    if whole or len(nodes) >= GROWN * joint.settled_nodes:
        snapshot = replace(snapshot, settled=joint.settled_edges)
        joint.settled_nodes, joint.settled_edges = len(nodes), edges
    else:
        first = joint.first_node_of(len(joint.dives) - 1)
        fixed = nodes.copy()
        fixed["component"][:first] = fixed["number"][:first]  # each stays: it is its own world
        snapshot = replace(snapshot, nodes=fixed)
    joint.graph.apply(solve(snapshot))


def _open(joint: JointGraph) -> tuple[Index, Index]:
    """Links that have no verdict yet: those within a component, and those between two."""
    links, component = joint.links, joint.graph.tables()["nodes"]["component"]
    left = np.flatnonzero((links["verdict"] == ALONE) & (links["edge"] < 0))
    within = component[links["node_a"][left]] == component[links["node_b"][left]]
    return left[within], left[~within]


def _between_components(joint: JointGraph) -> list[Index]:
    """The links that join two components, for each pair that enough of them join."""
    between, component = _open(joint)[1], joint.graph.tables()["nodes"]["component"]
    ends = [component[joint.links[name][between]] for name in ("node_a", "node_b")]
    pairs, of = np.unique(np.sort(np.array(ends).T, axis=1), axis=0, return_inverse=True)
    groups = [between[of.ravel() == pair] for pair in range(len(pairs))]
    return [numbers for numbers in groups if len(numbers) >= LEAST_AGREEING]


def _add(
    joint: JointGraph,
    numbers: Index,  # [L] of links
) -> None:
    """Add links to the graph, those of the most keypoints first."""
    for number in _by_inliers(joint, numbers):
        if joint.graph.add_edge(_edge(joint.links[number])):
            joint.links["edge"][number] = len(joint.graph.tables()["edges"]) - 1


def _by_inliers(
    joint: JointGraph,
    numbers: Index,  # [L] of links
) -> Index:
    return np.asarray(numbers[np.argsort(-joint.links["inliers"][numbers], kind="stable")])


def _edge(link: Rows) -> Edge:  # [] JOINT_LINK
    T_ba = Sim3(link["R"].copy(), link["t"].copy(), float(link["scale"]))
    return Edge(int(link["node_b"]), int(link["node_a"]), T_ba, link["information"], loop=True)


def _turned(edge: Edge) -> Edge:
    """The same measurement from the other end."""
    back = Sim3Batch.of([edge.T_ab.inverse()]).adjoint()[0]
    return Edge(edge.b, edge.a, edge.T_ab.inverse(), back.T @ edge.information @ back, loop=True)


@dataclass(frozen=True)
class _Comparison:
    """What comparing the links between two components found, by their numbers."""

    kept: Index = field(default_factory=lambda: np.zeros(0, np.intp))
    against: Index = field(default_factory=lambda: np.zeros(0, np.intp))


def _compare(
    joint: JointGraph,
    numbers: Index,  # [L] of links
) -> _Comparison:
    """Which of the links between two components agree with each other."""
    graph, compared = joint.graph, _by_inliers(joint, numbers)[:MOST_COMPARED]
    tables = graph.tables()
    component = tables["nodes"]["component"]
    # All from one component to the other, as rows of a graph that nothing else joins.
    edges = [_edge(joint.links[number]) for number in compared]
    first = component[edges[0].a]
    edges = [edge if component[edge.a] == first else _turned(edge) for edge in edges]
    alone = {name: rows if name == "nodes" else rows[:0] for name, rows in tables.items()}
    probe = PoseGraph.of_tables(alone, graph.config)
    compared = compared[[probe.add_edge(edge) for edge in edges]]
    rows, poses = probe.tables()["edges"], poses_of(tables["nodes"])
    chains = Chains(poses, tables["edges"], np.flatnonzero(tables["trust"]["trust"] > 0.0))
    strength = joint.links["inliers"][compared].astype(float).tolist()
    verdict = agreement(compatible_links(poses, chains, rows, graph.config), strength)
    if not verdict.kept:
        return _Comparison()
    return _Comparison(compared[list(verdict.kept)], compared[list(verdict.against)])


# --------------------------------------------------------------------------------------------------
# Which links of two components agree on how these lie to each other.
#
# Each link alone says where one component lies in the other. Two links are compared over the chains
# of keyframes between their ends: what is left over must be explained by the links' covariances and
# the chains'. The largest set in which all agree with all is kept (pairwise consistent
# measurements: Mangelson et al., ICRA 2018), found greedily from each link in turn.

Mask = npt.NDArray[np.bool_]

LEAST_AGREEING = 2
"""Links that must agree before two components are joined: one alone is believed by nothing else."""
MOST_COMPARED = 64
"""Links of two components that are compared with each other: those of the most keypoints. The time
grows with the square; the optimisation tests the others."""


@dataclass(frozen=True)
class Agreement:
    """The verdict on the links between two components."""

    kept: tuple[int, ...]
    """Indices of those that agree, in order; empty where they are not joined."""
    against: tuple[int, ...]
    """Indices of those that contradict the kept ones."""


def agreement(
    compatible: Mask,  # [n, n] symmetric
    strength: Sequence[float],
) -> Agreement:
    """The largest set found in which each is compatible with each; of equals the strongest.

    ``strength`` [n]: of each link. Fewer than ``LEAST_AGREEING`` are none.
    """
    count = len(compatible)
    best: tuple[int, ...] = ()
    for first in range(count):
        allowed = compatible[first].copy()
        allowed[first] = False
        clique = [first]
        while allowed.any():
            # The one that leaves the most open; of equals the strongest, then the earliest.
            options = np.flatnonzero(allowed).tolist()
            left = (compatible[options] & allowed).sum(axis=1).tolist()
            ranks = [(left[k], strength[i], -i) for k, i in enumerate(options)]
            chosen = options[ranks.index(max(ranks))]
            clique.append(chosen)
            allowed &= compatible[chosen]
            allowed[chosen] = False
        found = tuple(sorted(clique))
        if _rank(found, strength) > _rank(best, strength):
            best = found
    if len(best) < LEAST_AGREEING:
        return Agreement((), tuple(range(count)))
    return Agreement(best, tuple(i for i in range(count) if i not in best))


def _rank(links: tuple[int, ...], strength: Sequence[float]) -> tuple[int, float]:
    return len(links), sum(strength[i] for i in links)


def compatible_links(
    poses: Sim3Batch,  # [N]
    chains: Chains,
    links: Rows,  # [n] EDGE
    config: GraphConfig,
) -> Mask:
    """[n, n] which links agree with which; ``poses`` may have each component in a world of its own.

    A pair of links from one pair of keyframes is one measurement made twice, and is no agreement.
    """
    found = np.zeros((len(links), len(links)), dtype=bool)
    i, j = np.tril_indices(len(links), -1)
    other = (links["a"][i] != links["a"][j]) | (links["b"][i] != links["b"][j])
    i, j = i[other], j[other]
    if not len(i):
        return found
    measured = poses_of(links)
    claimed, seen = poses[links["a"]] @ measured, poses[links["b"]]
    T_ji = seen[j].inverse() @ seen[i]
    gap = (claimed[i].inverse() @ (claimed[j] @ T_ji)).log()
    back, ahead = T_ji.inverse().adjoint(), measured[i].inverse().adjoint()
    covariance = cache(lambda start, end: chains.covariance(chains.path(start, end)))
    at_a, at_b = (
        np.stack(
            [covariance(*ends) for ends in zip(*links[end][np.stack([j, i])].tolist(), strict=True)]
        )
        for end in ("a", "b")
    )
    own = links["covariance"][i] + _carried(back, links["covariance"][j])
    whole = own + config.drift_factor**2 * (at_b + _carried(ahead, at_a))
    chi2 = np.einsum("ni,ni->n", gap, np.linalg.solve(whole, gap[:, :, None])[:, :, 0])
    found[i, j] = found[j, i] = chi2 <= config.loop_chi2
    return found


def _carried(
    adjoint: Array,  # [k, 7, 7]
    covariance: Array,  # [k, 7, 7]
) -> Array:
    """[k, 7, 7] the covariances seen from elsewhere."""
    return np.asarray(adjoint @ covariance @ adjoint.transpose(0, 2, 1))
