"""Places of a dive that other dives of the site show too: by the index, proved by geometry.

What looking a dive up found is kept on disk: no dive is looked up twice among the same dives.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError
from aquaflow.base.storage.archive import UNREADABLE, read_facts_file, write_facts_file
from aquaflow.base.storage.atomic import make_subfolder
from aquaflow.config import VerificationConfig
from aquaflow.keyframes.place import KeypointDepths, PlacesFile
from aquaflow.survey.site.place_index import PlaceIndex, SimilarPlace
from aquaflow.tracking.graph.pose_graph import edge_information
from aquaflow.tracking.loops import Verified, verify_keypoints

Rows = npt.NDArray[Any]

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
ENOUGH = 5
"""Links of a keyframe after which no more of its candidates are tried."""
KEPT = 64
"""Keyframes whose keypoints stay in memory during a look-up: 1.2 MB each at 2000 keypoints."""

LINK = np.dtype(
    [
        ("dive", "<i4"),
        ("a", "<i8"),
        ("b", "<i8"),
        ("R", "<f8", (3, 3)),
        ("t", "<f8", (3,)),
        ("scale", "<f8"),
        ("information", "<f8", (7, 7)),
        ("inliers", "<i4"),
        ("matched", "<i4"),
        ("cells", "<i4"),
        ("similarity", "<f8"),
    ]
)
"""A keyframe ``b`` of the dive that was looked up, which shows a place of keyframe ``a`` of the
dive ``dive``, by its place in ``DiveLinks.among``. T_ba is from A's keyframe to B's in the units of
both, ``information`` of its right tangent; ``inliers``, ``matched`` and ``cells`` as in
:class:`aquaflow.tracking.loops.Verified`; ``similarity`` by the words of the two pictures."""


@dataclass(frozen=True)
class DiveLinks:
    """What looking a dive up in others found."""

    among: tuple[str, ...]
    """Fingerprints of the dives that it was looked for in."""
    rows: Rows
    """[n] LINK"""

    def __add__(self, other: DiveLinks) -> DiveLinks:
        """Those of two look-ups of one dive in different dives."""
        rows = other.rows.copy()
        rows["dive"] += len(self.among)
        return DiveLinks(self.among + other.among, np.concatenate([self.rows, rows]))


def find_links(
    index: PlaceIndex,
    places_of: Callable[[str], PlacesFile],
    dive: str,
    among: Collection[str],
    progress: Callable[[int, int], None] = lambda *_: None,
) -> DiveLinks:
    """All pairs of keyframes, one of ``dive``, that prove to show one place, in the order of
    numbers.

    Each is proved from its own keypoints alone; whether they agree with each other is not asked
    here. The same files give the same links.

    Args:
        index: holds all the dives.
        places_of: the keyframes of a dive, by fingerprint.
        dive: fingerprint of the one that is looked up.
        among: fingerprints of those that it is looked for in.
        progress: is called with the keyframes done, and how many there are.

    Raises:
        InputError: a file is damaged.
    """
    order, own = tuple(among), places_of(dive)
    place = {fingerprint: number for number, fingerprint in enumerate(order)}
    past = lru_cache(KEPT)(lambda dive, number: places_of(dive).keypoints(number))
    rows = []
    for done, keyframe in enumerate(own.places):
        candidates = index.similar(dive, keyframe.number, order)
        if candidates:
            seen = own.keypoints(keyframe.number)
            links = [
                _row(place[candidate.dive], candidate, keyframe.number, proof)
                for candidate, proof in _proved(candidates, past, seen)
            ]
            rows += sorted(links, key=lambda link: link[:2])
        progress(done + 1, len(own.places))
    return DiveLinks(order, np.array(rows, LINK) if rows else np.zeros(0, LINK))


def _proved(
    candidates: list[SimilarPlace],
    past: Callable[[str, int], KeypointDepths],
    seen: KeypointDepths,
) -> Iterator[tuple[SimilarPlace, Verified]]:
    found = 0
    for candidate in candidates:
        there = past(candidate.dive, candidate.number)
        proof = verify_keypoints(there, seen.keypoints, seen.camera, VERIFICATION, seen)
        if proof is not None:
            yield candidate, proof
            found += 1
            if found == ENOUGH:
                return


def _row(dive: int, candidate: SimilarPlace, number: int, proof: Verified) -> tuple[Any, ...]:
    T_ba, covariance = proof.estimate.T, proof.estimate.covariance
    sigma = float(np.hypot(np.sqrt(covariance[6, 6]), SCALE_SIGMA))
    pose = covariance[:6, :6] + np.diag([0.0, 0.0, 0.0, *[ROTATION_SIGMA**2] * 3])
    return (
        dive, candidate.number, number, T_ba.R, T_ba.t, T_ba.scale,
        edge_information(pose, sigma, T_ba), proof.inliers, proof.matched, proof.cells,
        candidate.similarity,
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------
# ``links/*.npz``: what looking up a dive found.

FOLDER = "links"
"""In a site."""
METHOD = 3
"""Raised whenever the same dives would give other links."""
MOST_BYTES = 1 << 28
"""Of one dive's: a link takes 0.6 kB, a dive among which it was looked for 70 bytes."""


def write_links(site: Path, dive: str, links: DiveLinks) -> None:
    """Write what looking up the dive with the fingerprint ``dive`` found, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    path = _file_of(site, dive)
    try:
        make_subfolder(path.parent)
    except OSError as error:
        raise InputError(f"cannot make {path.parent}: {error.strerror}; make room") from error
    about = {"of": [METHOD, dive], "among": links.among}
    write_facts_file(path, about, {"links": links.rows})


def read_links(site: Path, dive: str) -> DiveLinks | None:
    """What looking up the dive with the fingerprint ``dive`` found; None where that is to be
    done."""
    try:
        about, arrays = read_facts_file(_file_of(site, dive), folders=1, most_bytes=MOST_BYTES)
        rows = arrays["links"]
        among = tuple(str(each) for each in about["among"])
        if about["of"] != [METHOD, dive] or rows.dtype != LINK or rows.ndim != 1:
            return None
        if ((rows["dive"] < 0) | (rows["dive"] >= len(among))).any():
            raise DamagedError("a link is to no dive")
        return DiveLinks(among, rows)
    except (*UNREADABLE, AttributeError):
        return None


def _file_of(site: Path, dive: str) -> Path:
    return site / FOLDER / f"{dive[:16]}.npz"
