"""Links between dives in their joint graph: those that agree join sub-maps; all is optimised."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from aquaflow.survey.site.consistency import MOST_COMPARED, agreement, compatible_links
from aquaflow.survey.site.joint_graph import LEAST_TRUST, JointGraph
from aquaflow.survey.site.links import CrossLink
from aquaflow.tracking.graph.equations import poses_of
from aquaflow.tracking.graph.loop_admission import Chains
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph

Verdict = Literal["used", "alone", "contradicts the others", "contradicts the graph"]


@dataclass(frozen=True)
class JudgedLink:
    """A link between keyframes of two dives, and what became of it."""

    dive_a: int
    dive_b: int
    link: CrossLink
    verdict: Verdict


@dataclass(frozen=True)
class _Placed:
    """A link with its nodes and its edge from B's keyframe to A's."""

    dives: tuple[int, int]
    link: CrossLink
    edge: Edge


def join(
    joint: JointGraph, found: Mapping[tuple[int, int], Sequence[CrossLink]]
) -> list[JudgedLink]:
    """Join the sub-maps that agreeing links connect, and optimise all keyframes together.

    Args:
        joint: changed in place.
        found: links by the indices of the two dives, A's and B's.

    Returns:
        Every link with its verdict, in order.
    """
    pairs = _by_sub_maps(joint, found)
    verdicts: dict[int, Verdict] = {}
    agreeing: list[tuple[list[_Placed], list[_Placed]]] = []
    for links in pairs.values():
        kept, others = _compare(joint, links, verdicts)
        if kept:
            agreeing.append((kept, others))
    # The best proved first: an edge that joins two components is tested by nothing else.
    agreeing.sort(key=lambda pair: -len(pair[0]))
    added: list[_Placed] = []
    for kept, _ in agreeing:
        added += _add(joint, sorted(kept, key=lambda placed: -placed.link.inliers))
    for _, others in agreeing:
        added += _add(joint, others)
    before = len(joint.graph.tables()["edges"]) - len(added)
    joint.graph.optimise(everything=True)
    trust = joint.graph.tables()["trust"]["trust"][before:]
    for placed, how in zip(added, trust, strict=True):
        verdicts[id(placed.link)] = "used" if how >= LEAST_TRUST else "contradicts the graph"
    return [
        JudgedLink(*dives, link, verdicts.get(id(link), "alone"))
        for dives, links in found.items()
        for link in links
    ]


def _by_sub_maps(
    joint: JointGraph, found: Mapping[tuple[int, int], Sequence[CrossLink]]
) -> dict[tuple[int, int], list[_Placed]]:
    """Links by the indices of the sub-maps that they connect."""
    pairs = defaultdict[tuple[int, int], list[_Placed]](list)
    for dives, links in found.items():
        for link in links:
            a, b = joint.node(dives[0], link.a), joint.node(dives[1], link.b)
            edge = Edge(b, a, link.T_ba, link.information, loop=True)
            between = (joint.sub_map_of(a), joint.sub_map_of(b))
            pairs[between].append(_Placed(dives, link, edge))
    return pairs


def _compare(
    joint: JointGraph, links: list[_Placed], verdicts: dict[int, Verdict]
) -> tuple[list[_Placed], list[_Placed]]:
    """Those that agree, and those that were not compared, of the links of two sub-maps."""
    order = sorted(links, key=lambda placed: -placed.link.inliers)
    compared, others = order[:MOST_COMPARED], order[MOST_COMPARED:]
    # The edges as rows of a graph, without joining anything.
    graph = joint.graph
    tables = graph.tables()
    probe = PoseGraph.of_tables(tables, graph.config)
    compared = [placed for placed in compared if probe.add_edge(placed.edge)]
    rows = probe.tables()["edges"][len(tables["edges"]) :]
    poses = poses_of(tables["nodes"])
    chains = Chains(poses, tables["edges"], np.flatnonzero(tables["trust"]["trust"] > 0.0))
    strength = [float(placed.link.inliers) for placed in compared]
    verdict = agreement(compatible_links(poses, chains, rows, graph.config), strength)
    of_others: Verdict = "contradicts the others" if verdict.kept else "alone"
    for index in verdict.against:
        verdicts[id(compared[index].link)] = of_others
    if not verdict.kept:
        verdicts.update((id(placed.link), "alone") for placed in others)
        return [], []
    return [compared[index] for index in verdict.kept], others


def _add(joint: JointGraph, links: list[_Placed]) -> list[_Placed]:
    return [placed for placed in links if joint.graph.add_edge(placed.edge)]
