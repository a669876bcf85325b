"""Links between dives in their joint graph: those that agree join sub-maps; all is optimised."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from aquaflow.config import GraphConfig, RetrievalConfig, VerificationConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes.place import KeyframePlace, PlacesFile
from aquaflow.survey.site.joint_graph import LEAST_TRUST, JointGraph
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.graph.loop_admission import Chains, gap_chi2
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph, edge_information
from aquaflow.tracking.loops import Retrieval, verify_keypoints

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


# --------------------------------------------------------------------------------------------------
# Places of one dive that another dive shows too: retrieved by words, proved by geometry.

Array = npt.NDArray[np.float64]

RETRIEVAL = RetrievalConfig(neighbour_share=0.0, min_similarity=0.01, candidates=5)
"""A place in another dive, seen in other water and light, is less like itself than neighbours on a
path are: the true pairs of the reef clip's halves have similarities from 0.02. So only what chance
gives is asked for, more candidates are tried, and verification decides."""
SCALE_SIGMA = 0.05
"""Relative scale that a link may be wrong by, beside its own covariance. The depths of two dives
differ by what each dive's start left wrong: against structure from motion, the scales of the links
of two dives are 0.3 to 2.2 % off on the reef and Curasao clips, and those of one pair of dives all
to one side. A dozen links do not average that out: 1.5 % times the root of 12. What the cameras
moved, seen in both dives, says more of the scale (notes/2026-11-sites.md#merge)."""
ROTATION_SIGMA = 5e-4
"""rad, likewise: the rotations of links of the same dives differ by 0.1 to 0.3 degrees, with a
stated 0.01 to 0.05."""
VERIFICATION = VerificationConfig()
"""As within a dive."""


@dataclass(frozen=True)
class CrossLink:
    """A keyframe of dive B that shows a place of a keyframe of dive A."""

    a: int
    """Keyframe number in A."""
    b: int
    """Keyframe number in B."""
    T_ba: Sim3
    """A's keyframe to B's, in the units of both."""
    information: Array
    """[7, 7] of its right tangent."""
    inliers: int
    matched: int
    cells: int
    """As in :class:`aquaflow.tracking.loops.Verified`."""
    similarity: float
    """By the words of the two pictures."""


def find_links(
    a: PlacesFile, b: PlacesFile, progress: Callable[[int, int], None] = lambda *_: None
) -> list[CrossLink]:
    """All pairs of keyframes that prove to show one place, ordered by B's and A's numbers.

    Each is proved from its own keypoints alone; whether they agree with each other is not asked
    here. The same files give the same links.

    Raises:
        InputError: a file is damaged.
    """
    retrieval = Retrieval(RETRIEVAL)
    for place in a.places:
        retrieval.add(place.number, a.keypoints(place.number))
    links: list[CrossLink] = []
    for done, place in enumerate(b.places):
        links += _of_keyframe(a, retrieval, b, place)
        progress(done + 1, len(b.places))
    return sorted(links, key=lambda link: (link.b, link.a))


def _of_keyframe(
    a: PlacesFile, retrieval: Retrieval, b: PlacesFile, place: KeyframePlace
) -> Iterator[CrossLink]:
    own = b.keypoints(place.number)
    for candidate in retrieval.candidates(own, exclude=lambda _: False):
        past = a.keypoints(candidate.number)
        proof = verify_keypoints(past, own.keypoints, own.camera, VERIFICATION, own)
        if proof is None:
            continue
        T_ba, covariance = proof.estimate.T, proof.estimate.covariance
        sigma = float(np.hypot(np.sqrt(covariance[6, 6]), SCALE_SIGMA))
        pose = covariance[:6, :6] + np.diag([0.0, 0.0, 0.0, *[ROTATION_SIGMA**2] * 3])
        information = edge_information(pose, sigma, T_ba)
        yield CrossLink(
            candidate.number, place.number, T_ba, information, proof.inliers, proof.matched,
            proof.cells, candidate.similarity,
        )  # fmt: skip


# --------------------------------------------------------------------------------------------------
# Which links of two sub-maps agree on how these lie to each other.
#
# Each link alone says where one sub-map lies in the other. Two links are compared over the chains
# of keyframes between their ends: what is left over must be explained by the links' covariances and
# the chains'. The largest set in which all agree with all is kept (pairwise consistent
# measurements: Mangelson et al., ICRA 2018), found greedily from each link in turn.

Mask = npt.NDArray[np.bool_]

LEAST_AGREEING = 2
"""Links that must agree before two sub-maps are joined: one alone is believed by nothing else."""
MOST_COMPARED = 64
"""Links of two sub-maps that are compared with each other: those of the most keypoints. The time
grows with the square; the optimisation tests the others."""


@dataclass(frozen=True)
class Agreement:
    """The verdict on the links between two sub-maps."""

    kept: tuple[int, ...]
    """Indices of those that agree, in order; empty where the sub-maps are not joined."""
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
    """[n, n] which links agree with which; ``poses`` may have each sub-map in a world of its own.

    A pair of links from one pair of keyframes is one measurement made twice, and is no agreement.
    """
    count = len(links)
    found = np.zeros((count, count), dtype=bool)
    at, seen, measured = poses[links["a"]], poses[links["b"]], poses_of(links)
    for i in range(count):
        # Both sides in the world of a, as link i has it.
        own = slice(i, i + 1)
        to_a = at[own] @ measured[own] @ seen[own].inverse()
        for j in range(i):
            both = np.array([j, i])
            pair = links[both]
            if (pair[0]["a"], pair[0]["b"]) == (pair[1]["a"], pair[1]["b"]):
                continue
            moved = Sim3Batch(*(np.repeat(part, 2, 0) for part in (to_a.R, to_a.t, to_a.scale)))
            gap = gap_chi2(pair, at[both], moved @ seen[both], chains, config)
            found[i, j] = found[j, i] = gap <= config.loop_chi2
    return found
