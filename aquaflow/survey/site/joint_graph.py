"""The keyframe graphs of several dives as one: each sub-map in its own world, until links join it.

Edges within a dive are the relative poses that it ended with, as certain as they were measured:
what telemetry, the map and the dive's own loops have corrected stays, and is bent only as far as
links to other dives ask for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import KeyframePlace, PlacesFile
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph

LEAST_TRUST = 0.5
"""Of a loop within a dive that is taken over, as in ``tracking/graph/optimisation.py``."""
BRIDGE_SIGMA = 0.1
"""1 sigma of the relative pose of consecutive keyframes that no edge joins any more, because a
keyframe between them was lost: in median depths, rad and log-scale. Judgement: ten times what a
link along the path has."""


@dataclass(frozen=True)
class SubMap:
    """A sub-map of one of the site's dives."""

    dive: int
    """Index of the dive."""
    number: int
    """Of the sub-map in its dive."""
    frame: WorldFrame
    places: tuple[KeyframePlace, ...]
    """In order."""

    def start(self, place: KeyframePlace) -> Sim3:
        """T_nc of a keyframe, with the scale that takes its unit to that of n."""
        return self.frame.T_nm @ place.T_mc


def sub_maps_of(dive: int, file: PlacesFile, frames: dict[int, WorldFrame]) -> list[SubMap]:
    """The sub-maps of a dive that have keyframes."""
    numbers = sorted({place.sub_map for place in file.places})
    return [
        SubMap(
            dive, number, frames.get(number, WorldFrame.unknown()),
            tuple(place for place in file.places if place.sub_map == number),
        )
        for number in numbers
    ]  # fmt: skip


def by_knowledge(sub_map: SubMap) -> tuple[object, ...]:
    """Key for sorting: the sub-map in whose world others are expressed comes first."""
    frame = sub_map.frame
    known = (frame.georeferenced, frame.metric and frame.level, frame.metric, frame.level)
    sigma = frame.scale_sigma if frame.metric else 0.0
    unknown = tuple(not each for each in known)
    return (*unknown, sigma, -len(sub_map.places), sub_map.dive, sub_map.number)


class JointGraph:
    """Nodes are numbered through: sub-map after sub-map, each in the order of its keyframes."""

    def __init__(self, sub_maps: Sequence[SubMap], files: Sequence[PlacesFile]) -> None:
        """``sub_maps`` in the order of :func:`by_knowledge`; ``files`` by dive."""
        self.sub_maps = tuple(sub_maps)
        self.graph = PoseGraph()
        self._node: dict[tuple[int, int], int] = {}
        """By dive and keyframe number."""
        self._sub_map_of: list[int] = []
        for index, sub_map in enumerate(self.sub_maps):
            for place in sub_map.places:
                node = len(self._sub_map_of)
                self._node[sub_map.dive, place.number] = node
                self._sub_map_of.append(index)
                self.graph.add_keyframe(node, sub_map.start(place))
        for dive, file in enumerate(files):
            self._add_edges(dive, file)
        for sub_map in self.sub_maps:
            self._add_bridges(sub_map)

    def __contains__(self, keyframe: tuple[int, int]) -> bool:
        """True for the dive and number of a keyframe that is a node."""
        return keyframe in self._node

    def node(self, dive: int, keyframe: int) -> int:
        """Number of a keyframe's node."""
        return self._node[dive, keyframe]

    def sub_map_of(self, node: int) -> int:
        """Index of the sub-map that a node belongs to."""
        return self._sub_map_of[node]

    def component_of(self, sub_map: int) -> int:
        """Index of the first sub-map of the component that a sub-map belongs to."""
        return self._sub_map_of[self.graph.component_of(self._first(sub_map))]

    def poses(self, sub_map: int) -> list[Sim3]:
        """T_sc of the sub-map's keyframes as the graph has them now."""
        first, count = self._first(sub_map), len(self.sub_maps[sub_map].places)
        return [self.graph.pose(node) for node in range(first, first + count)]

    def _first(self, sub_map: int) -> int:
        chosen = self.sub_maps[sub_map]
        return self._node[chosen.dive, chosen.places[0].number]

    def _add_edges(self, dive: int, file: PlacesFile) -> None:
        for row in file.edges:
            a, b = ((dive, int(row[end])) for end in ("a", "b"))
            if row["trust"] >= LEAST_TRUST and self._together((a, b)):
                self._add(self._node[a], self._node[b], np.array(row["information"]))

    def _together(self, keyframes: Iterable[tuple[int, int]]) -> bool:
        return len({self._sub_map_of[self._node[each]] for each in keyframes}) == 1

    def _add(
        self,
        a: int,
        b: int,
        information: np.ndarray,  # [7, 7]
    ) -> None:
        T_ab = self.graph.pose(a).inverse() @ self.graph.pose(b)
        self.graph.add_edge(Edge(a, b, T_ab, information))

    def _add_bridges(self, sub_map: SubMap) -> None:
        nodes = [self._node[sub_map.dive, place.number] for place in sub_map.places]
        for before, after in pairwise(nodes):
            if self.graph.component_of(before) != self.graph.component_of(after):
                self._add(after, before, np.eye(7) / BRIDGE_SIGMA**2)
