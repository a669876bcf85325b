"""The keyframe graph: links along the path, loops across it, and what they correct (Sec. 3.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from aquaflow.config import TrackingConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore
from aquaflow.tracking.frames import Link
from aquaflow.tracking.places import Places
from aquaflow.tracking.pose_graph import Edge, PoseGraph, edge_information


@dataclass(frozen=True)
class Correction:
    """What a keyframe changed of the map made before it."""

    moves: Mapping[int, Sim3] = field(default_factory=dict)
    """By keyframe number: the similarity from where its world was to where it is."""
    merged: Mapping[int, int] = field(default_factory=dict)
    """Sub-maps that became part of another: from, into."""
    loops: int = 0
    """Loop edges found."""


class KeyframeGraph:
    """Grows with the keyframes; sets their poses and sub-maps when the graph was optimised."""

    def __init__(self, keyframes: KeyframeStore, places: Places, config: TrackingConfig) -> None:
        self.graph = PoseGraph(config.graph)
        self._keyframes, self._places, self._config = keyframes, places, config.graph
        self._known: list[Keyframe] = []
        """In the graph; the store may hold some that are not yet."""

    def add(self, number: int, link: Link | None) -> Correction:
        """A new keyframe and how it hangs on the one it was tracked against."""
        keyframe = self._keyframes[number]
        if link is not None:  # the earlier one may have been moved since they were linked
            earlier = self._keyframes[link.keyframe]
            keyframe.T_wc = earlier.T_wc @ link.T_fk.inverse()
            keyframe.sub_map = earlier.sub_map
        self.graph.add_keyframe(number, keyframe.T_wc)
        self._known.append(keyframe)
        if link is not None:
            sigma = self._config.link_scale_sigma
            information = edge_information(link.covariance, sigma, link.T_fk)
            self.graph.add_edge(Edge(number, link.keyframe, link.T_fk, information))
        loops = self._close_loops(keyframe) if self._config.enabled else 0
        self._places.add(keyframe)
        return self._corrected(loops) if loops else Correction()

    def _close_loops(self, keyframe: Keyframe) -> int:
        """Edges to all earlier keyframes that prove to show the same place; their number."""
        number, component = keyframe.number, self.graph.component_of(keyframe.number)

        def on_the_path(other: int) -> bool:
            near = abs(number - other) < self._config.loop_gap
            return near and self.graph.component_of(other) == component

        loops = 0
        for found in self._places.of_keyframe(keyframe, on_the_path):
            T_fk, covariance = found.estimate.T, found.estimate.covariance
            sigma = float(np.sqrt(covariance[6, 6]))
            information = edge_information(covariance[:6, :6], sigma, T_fk)
            edge = Edge(number, found.keyframe.number, T_fk, information, loop=True)
            loops += self.graph.add_edge(edge)
        return loops

    def _corrected(self, loops: int) -> Correction:
        """Optimise, and let the keyframes take over what came out."""
        poses = self.graph.optimise().poses
        moves, merged = {}, {}
        for number, T_wc in poses.items():
            keyframe = self._keyframes[number]
            moves[number] = T_wc @ keyframe.T_wc.inverse()
            keyframe.T_wc = T_wc
        for keyframe in self._known:
            root = self._keyframes[self.graph.component_of(keyframe.number)]
            if keyframe.sub_map != root.sub_map:
                merged[keyframe.sub_map] = root.sub_map
                keyframe.sub_map = root.sub_map
        return Correction(moves, merged, loops)
