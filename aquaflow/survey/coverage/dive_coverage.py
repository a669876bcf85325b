"""What the camera has seen in a dive, sub-map by sub-map, as its keyframes are made and moved."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from itertools import islice

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.config.service import CoverageConfig
from aquaflow.dive.placement import page_axes, page_rotation
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore
from aquaflow.survey.coverage.footprint import Footprint
from aquaflow.survey.coverage.page_view import PageView, page_view
from aquaflow.survey.coverage.sub_map_coverage import REDRAWN, SubMapCoverage
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

READ = 4
"""Keyframes whose pointmaps are read in a turn; after a restart they come back from files, 5 MB
each, and tracking waits for the store meanwhile."""
FOLLOWED = 500
"""Keyframes whose pose is compared in a turn, newest ones and others: of a dive of ten hours each
is within a minute and a half."""
MOST_PLACES = 1000
"""Newest keyframes that the path and its lines are of; of those before at most as many more."""


class DiveCoverage:
    """Any thread may call it; each waits for the others."""

    def __init__(self, config: CoverageConfig) -> None:
        self.config = config
        self.lock = threading.RLock()
        self.sub_maps: dict[int, SubMapCoverage] = {}
        self._known: dict[int, tuple[Sim3, int]] = {}
        """T_wc and sub-map of each keyframe, as they are counted."""
        self._next_followed = 0
        self._final: set[int] = set()
        """Keyframes whose pointmap was read after it was last changed, or cannot be read."""

    def look(
        self,
        store: KeyframeStore,
        frame_of: Callable[[int], WorldFrame],
        everything: bool = False,
    ) -> None:
        """Take in what is new of ``store``; ``everything``, or as much as a turn is for.

        Args:
            frame_of: a sub-map, as telemetry has shown it by now.
        """
        with self.lock:
            keyframes = list(store.keyframes)  # tracking appends to it meanwhile
            self._follow(keyframes if everything else self._due(keyframes))
            newest = None if everything or not keyframes else keyframes[-1].number
            for keyframe in self._unread(keyframes, len(keyframes) if everything else READ):
                self._read(keyframe, final=keyframe.number != newest)
            for number, coverage in self.sub_maps.items():
                coverage.turn(_rotation(keyframes, number, frame_of(number)))

    def _due(self, keyframes: list[Keyframe]) -> list[Keyframe]:
        """The newest keyframes, which move most often, and the next ones of the others in turn."""
        newest, rest = keyframes[-FOLLOWED:], keyframes[:-FOLLOWED]
        if not rest:
            return newest
        first = self._next_followed % len(rest)
        self._next_followed = first + FOLLOWED
        return rest[first : first + FOLLOWED] + newest

    def _unread(self, keyframes: list[Keyframe], most: int) -> list[Keyframe]:
        """Those whose pointmap is to be read, newest first."""
        if len(self._final) >= len(keyframes):
            return []
        left = (each for each in reversed(keyframes) if each.number not in self._final)
        return list(islice(left, most))

    def update(self, most: int = REDRAWN) -> int:
        """One turn of every sub-map; how many keyframes were drawn."""
        with self.lock:
            return sum(coverage.update(most) for coverage in self.sub_maps.values())

    def settle(self) -> None:
        """Everything that was taken in is drawn where it is now."""
        with self.lock:
            for coverage in self.sub_maps.values():
                coverage.settle()

    def views(
        self,
        store: KeyframeStore,
        frame_of: Callable[[int], WorldFrame],
        limits: Mapping[int, float | None],
    ) -> dict[int, PageView]:
        """What is shown of each sub-map; ``limits``: ranges that its water allows, map units."""
        keyframes, shown = list(store.keyframes), {}
        with self.lock:
            for number, coverage in sorted(self.sub_maps.items()):
                path, limit = _path(keyframes, number), limits.get(number)
                view = page_view(number, coverage, path, frame_of(number), limit, self.config)
                if view is not None:
                    shown[number] = view
        return shown

    def _follow(self, keyframes: Sequence[Keyframe]) -> None:
        """Poses and sub-maps of what is counted."""
        moves: dict[int, dict[int, Sim3]] = {}
        for keyframe in keyframes:
            known = self._known.get(keyframe.number)
            if known is None:
                continue
            T_wc, sub_map = keyframe.T_wc, keyframe.sub_map
            if sub_map != known[1]:
                self._change(keyframe.number, T_wc, known[1], sub_map)
            elif T_wc is not known[0]:
                moves.setdefault(sub_map, {})[keyframe.number] = T_wc
            self._known[keyframe.number] = T_wc, sub_map
        for sub_map, poses in moves.items():
            self.sub_maps[sub_map].move(poses)

    def _change(self, number: int, T_wc: Sim3, before: int, now: int) -> None:
        """A keyframe of a sub-map that became part of another."""
        sight = self.sub_maps[before].seen.get(number)
        self.sub_maps[before].take_out(number)
        if sight is not None:
            self._of(now).put(number, sight[0], T_wc)

    def _read(self, keyframe: Keyframe, final: bool) -> None:
        T_wc, sub_map = keyframe.T_wc, keyframe.sub_map
        try:
            footprint = Footprint.of(keyframe.pointmap)
        except InputError:  # its file was lost: it has a pose, and shows nothing
            self._final.add(keyframe.number)
            return
        self._of(sub_map).put(keyframe.number, footprint, T_wc)
        self._known[keyframe.number] = T_wc, sub_map
        if final:
            self._final.add(keyframe.number)

    def _of(self, sub_map: int) -> SubMapCoverage:
        if sub_map not in self.sub_maps:
            self.sub_maps[sub_map] = SubMapCoverage(self.config.cells, np.eye(3))
        return self.sub_maps[sub_map]


def _path(keyframes: Sequence[Keyframe], sub_map: int) -> Array:
    """[N, 3] centres in the sub-map's world: all of the newest keyframes, some of the others."""
    own = [each for each in keyframes if each.sub_map == sub_map]
    step = max(1, len(own) // MOST_PLACES)
    chosen = own[:-MOST_PLACES:step] + own[-MOST_PLACES:]
    return np.array([each.T_wc.t for each in chosen]).reshape(-1, 3)


def _rotation(keyframes: Sequence[Keyframe], sub_map: int, frame: WorldFrame) -> Array:
    """[3, 3] page from the sub-map's world."""
    path = _path(keyframes, sub_map)
    centres = frame.T_nm.apply(path if len(path) else np.zeros((1, 3)))
    return page_rotation(page_axes(frame, centres)) @ frame.T_nm.R
