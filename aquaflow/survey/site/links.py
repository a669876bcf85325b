"""Places of one dive that another dive shows too: retrieved by words, proved by geometry."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import RetrievalConfig, VerificationConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import KeyframePlace
from aquaflow.keyframes.places_file import PlacesFile
from aquaflow.tracking.graph.pose_graph import edge_information
from aquaflow.tracking.loops.relocaliser import Retrieval
from aquaflow.tracking.loops.verification import verify_keypoints

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
    """As in :class:`aquaflow.tracking.loops.verification.Verified`."""
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
