"""All configured objects of known size in a dive: found once, measured with the poses of now."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from copy import copy

import numpy as np
import numpy.typing as npt

from aquaflow.config.telemetry import FusionConfig
from aquaflow.telemetry.known_lengths.board_size import (
    BoardDetector,
    BoardSighting,
    BoardView,
    board_lengths,
)
from aquaflow.telemetry.known_lengths.known_length import KnownLength
from aquaflow.telemetry.known_lengths.laser_spacing import (
    DOTS,
    DotCandidates,
    find_dots,
    laser_lengths,
)

Array = npt.NDArray[np.float64]


class KnownLengthFinder:
    """Keeps where the objects were seen, a kilobyte a picture, and no picture."""

    def __init__(self, config: FusionConfig) -> None:
        self._detector = BoardDetector(config.boards)
        self._lasers = config.lasers
        self._boards: list[BoardSighting] = []
        self._dots: list[DotCandidates] = []

    def look(
        self,
        frame_index: int,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB, undistorted
    ) -> Array:
        """Look for the objects in a picture: 6 to 9 ms of CPU for each at 640 x 480 px.

        Returns [N, 2] where something was seen: there the picture's depth is worth keeping.
        """
        boards = self._detector(frame_index, image)
        self._boards += boards
        seen = [each.pixels for each in boards]
        if self._lasers is not None:
            dots = find_dots(frame_index, image, self._lasers.colour)
            if len(dots.pixels):
                self._dots.append(dots)
                seen.append(dots.pixels)
        return np.concatenate([np.zeros((0, 2)), *seen])

    def __bool__(self) -> bool:
        """True once something was seen."""
        return bool(self._boards or self._dots)

    def copy(self) -> KnownLengthFinder:
        """What was seen until now, to be measured by another thread."""
        other = copy(self)
        other._boards, other._dots = list(self._boards), list(self._dots)
        return other

    def lengths(self, view_of: Callable[[int], BoardView | None]) -> list[KnownLength]:
        """What was seen until now, measured in the map as it is now.

        ``view_of`` gives a frame's place by its index; None for a frame without a pose.
        """
        lengths = board_lengths(self._boards, view_of)
        if self._lasers is not None:
            lengths += laser_lengths(self._dots, view_of, self._lasers)
        return lengths

    def count_seen(self, view_of: Callable[[int], BoardView | None]) -> Counter[tuple[int, str]]:
        """Pictures with a pose that show each object, by sub-map and name."""
        found: Counter[tuple[int, str]] = Counter()
        names = [(each.frame_index, each.name) for each in self._boards]
        for frame_index, name in [*names, *((dots.frame_index, DOTS) for dots in self._dots)]:
            view = view_of(frame_index)
            if view is not None:
                found[view.sub_map, name] += 1
        return found
