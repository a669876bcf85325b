"""Which links of two sub-maps agree on how these lie to each other.

Each link alone says where one sub-map lies in the other. Two links are compared over the chains of
keyframes between their ends: what is left over must be explained by the links' covariances and the
chains'. The largest set in which all agree with all is kept (pairwise consistent measurements:
Mangelson et al., ICRA 2018), found greedily from each link in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3Batch
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.graph.loop_admission import Chains, gap_chi2

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
