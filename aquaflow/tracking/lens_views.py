"""Which pictures of a dive show its lens: a bounded number, evenly spread over the motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Keypoints
from aquaflow.tracking.lens_matches import LensView

MOST_VIEWS = 32
"""At once: the adjustment of as many takes a few seconds."""
FIRST_SPACING = 0.01
"""Motion from one view to the next, picture widths; doubled when there are too many views."""
LAST_SPACING = 0.16
"""With a third of the picture's height, the views three further on still show the same."""


@dataclass(frozen=True)
class _Candidate:
    frame_index: int
    keypoints: Keypoints
    sub_map: int


class LensViews:
    """Views of one camera in the order of the dive; where too many came, every other one is left
    out and the next ones come half as often."""

    def __init__(self, guess: CameraModel) -> None:
        self._guess, self._spacing = guess, FIRST_SPACING
        self._views: list[_Candidate] = []
        self._last: tuple[Sim3, int] | None = None

    def offer(
        self,
        frame_index: int,
        T_wc: Sim3,
        sub_map: int,
        rho: float,
        keypoints: Callable[[], Keypoints],
    ) -> None:
        """Take the picture as a view if the camera has moved far enough since the last one.

        ``rho``: median inverse depth of what it sees, 1 / world units.
        """
        if self._last is not None and self._last[1] == sub_map:
            moved = motion(self._last[0], T_wc, rho) * self._guess.fx / self._guess.width
            if moved < self._spacing:
                return
        self._last = (T_wc, sub_map)
        self._views.append(_Candidate(frame_index, keypoints(), sub_map))

    @property
    def full(self) -> bool:
        """True if :meth:`thin` should make room."""
        return len(self._views) >= MOST_VIEWS

    @property
    def complete(self) -> bool:
        """True if views further apart would no longer show the same."""
        return self.full and self._spacing >= LAST_SPACING

    def thin(self) -> None:
        """Leave out every other view."""
        self._views, self._spacing = self._views[::2], 2.0 * self._spacing

    def posed_views(self, poses: Mapping[int, Sim3]) -> list[LensView]:
        """Those of the sub-map with most views, with the poses by frame index."""
        seen = [view for view in self._views if view.frame_index in poses]
        if not seen:
            return []
        [(largest, _)] = Counter(view.sub_map for view in seen).most_common(1)
        return [
            LensView(view.keypoints, self._guess, poses[view.frame_index])
            for view in seen
            if view.sub_map == largest
        ]


def motion(before: Sim3, now: Sim3, rho: float) -> float:
    """About how far the picture moved, radians; ``rho`` as of :meth:`LensViews.offer`."""
    cosine = 0.5 * (float(np.sum(before.R * now.R)) - 1.0)
    turn = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return turn + rho * float(np.linalg.norm(now.t - before.t))
