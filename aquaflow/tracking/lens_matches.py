"""Keypoint matches between pictures as observations of points, for an adjustment of the lens."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Keypoints, Mask
from aquaflow.tracking.lens_equations import LensObservations
from aquaflow.tracking.loops.keypoints import Index, match_keypoints

MATCHES_PER_PAIR = 200
"""At most; of more, an even choice: matches of one pair of views share errors."""
MIN_MATCHES = 300
"""Of all pairs together."""
MIN_PAIR_MATCHES = 20
"""Of one pair: as many mismatches are found between pictures of different places."""

Seen = tuple[int, int]
"""A keypoint: the number of its view, and its own there."""


@dataclass(frozen=True)
class LensView:
    """A picture whose keypoints show the lens."""

    keypoints: Keypoints
    camera: CameraModel
    """The one whose error is asked for."""
    T_wc: Sim3
    """Roughly right."""

    def where(
        self,
        shown: Mask | None,  # [H, W] True where the scene is seen; None: everywhere
    ) -> LensView:
        """The view with its keypoints there."""
        if shown is None:
            return self
        height, width = shown.shape
        column, row = np.floor(self.keypoints.pixels).astype(np.intp).T
        kept = shown[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        pixels, descriptors = self.keypoints.pixels[kept], self.keypoints.descriptors[kept]
        return replace(self, keypoints=Keypoints(pixels, descriptors))


class _Points:
    """Points by the keypoints that see them; the first keypoint is where a point is sampled."""

    def __init__(self) -> None:
        self.seen: list[list[Seen]] = []
        self._owner: dict[Seen, int] = {}

    def is_known(self, keypoint: Seen) -> bool:
        return keypoint in self._owner

    def add(self, a: Seen, b: Seen) -> None:
        """They see the same; what contradicts an earlier match is left out."""
        if b in self._owner:
            return
        point = self._owner.get(a)
        if point is None:
            point = self._owner[a] = len(self.seen)
            self.seen.append([a])
        if all(view != b[0] for view, _ in self.seen[point]):
            self.seen[point].append(b)
            self._owner[b] = point


def match_pixels(
    views: Sequence[LensView], pairs: Iterable[tuple[int, int]]
) -> LensObservations | None:
    """Points seen in several of ``views``, by matches of ``pairs`` (i, j) with i < j; None for too
    few. A keypoint belongs to one point, so that no match counts twice."""
    points = _Points()
    for i, j in sorted(pairs):
        mine, theirs = match_keypoints(views[i].keypoints, views[j].keypoints)
        if len(mine) < MIN_PAIR_MATCHES:
            continue
        known = np.array([points.is_known((i, a)) for a in mine.tolist()])
        for row in _choose(known).tolist():
            points.add((i, int(mine[row])), (j, int(theirs[row])))
    seen = [each for each in points.seen if len(each) > 1]
    if sum(len(each) - 1 for each in seen) < MIN_MATCHES:
        return None
    plane = [view.camera.unproject(view.keypoints.pixels)[:, :2] for view in views]
    matches = [(row, *keypoint) for row, each in enumerate(seen) for keypoint in each[1:]]
    return LensObservations(
        np.stack([plane[view][keypoint] for (view, keypoint), *_ in seen]),
        np.array([view for (view, _), *_ in seen], dtype=np.int64),
        np.array([row for row, _, _ in matches], dtype=np.int64),
        np.array([view for _, view, _ in matches], dtype=np.int64),
        np.stack([plane[view][keypoint] for _, view, keypoint in matches]),
    )


def _choose(
    known: np.ndarray[tuple[int], np.dtype[np.bool_]],  # [M] whether another view sees it too
) -> Index:
    """Rows of the matches used: first of points that other views see, then an even choice."""
    longer, single = np.flatnonzero(known), np.flatnonzero(~known)
    room = max(0, MATCHES_PER_PAIR - len(longer))
    step = -(-len(single) // room) if room else len(single) + 1
    return np.concatenate([longer[:: max(1, -(-len(longer) // MATCHES_PER_PAIR))], single[::step]])
