"""What the camera has seen in a dive, sub-map by sub-map, as its keyframes are made and moved."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.config.coverage import CoverageConfig
from aquaflow.coverage.footprint import Footprint
from aquaflow.coverage.page_axes import page_axes, page_rotation
from aquaflow.coverage.sub_map_coverage import REDRAWN, SubMapCoverage
from aquaflow.errors import InputError
from aquaflow.fusion.metric_frame import MetricFrame
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore

Array = npt.NDArray[np.float64]

READ = 4
"""Keyframes whose pointmaps are read in a turn; after a restart they come back from files, 5 MB
each, and tracking waits for the store meanwhile."""


class DiveCoverage:
    """For one thread at a time, which may be another than tracking's."""

    def __init__(self, config: CoverageConfig) -> None:
        self.config = config
        self.sub_maps: dict[int, SubMapCoverage] = {}
        self._known: dict[int, tuple[Sim3, int]] = {}
        """T_wc and sub-map of each keyframe, as they are counted."""
        self._final: set[int] = set()
        """Keyframes whose pointmap was read after it was last changed, or cannot be read."""

    def look(
        self,
        store: KeyframeStore,
        frame_of: Callable[[int], MetricFrame],
        most_read: int = READ,
    ) -> None:
        """Take in what is new of ``store`` since the last look, ``most_read`` pointmaps of it at
        most; ``frame_of`` a sub-map."""
        keyframes = list(store.keyframes)  # tracking appends to it meanwhile
        self._follow(keyframes)
        newest = keyframes[-1].number if keyframes else None
        wanted = [each for each in reversed(keyframes) if each.number not in self._final]
        for keyframe in wanted[:most_read]:
            self._read(keyframe, final=keyframe.number != newest)
        for number, coverage in self.sub_maps.items():
            coverage.turn(self.rotation(keyframes, number, frame_of(number)))

    def update(self, most: int = REDRAWN) -> int:
        """One turn of every sub-map; how many keyframes were drawn."""
        return sum(coverage.update(most) for coverage in self.sub_maps.values())

    def settle(self) -> None:
        """Everything that was taken in is drawn where it is now."""
        for coverage in self.sub_maps.values():
            coverage.settle()

    @staticmethod
    def of(
        store: KeyframeStore, frames: Mapping[int, MetricFrame], config: CoverageConfig
    ) -> DiveCoverage:
        """Of a dive that is over."""
        made = DiveCoverage(config)
        made.look(store, lambda n: frames.get(n, MetricFrame.unknown()), len(store.keyframes))
        made.settle()
        return made

    def rotation(self, keyframes: Sequence[Keyframe], sub_map: int, frame: MetricFrame) -> Array:
        """[3, 3] page from the sub-map's world."""
        path = np.array([each.T_wc.t for each in keyframes if each.sub_map == sub_map])
        if len(path) == 0:
            path = np.zeros((1, 3))
        axes = page_axes(frame, frame.T_nm.apply(path))
        return page_rotation(axes) @ frame.T_nm.R

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
