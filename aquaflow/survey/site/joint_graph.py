"""The keyframe graphs of several dives as one: each sub-map in its own world, until links join it.

Edges within a dive are the relative poses that it ended with, as certain as they were measured:
what telemetry, the map and the dive's own loops have corrected stays, and is bent only as far as
links to other dives ask for it.

The graph grows dive by dive, and is kept on disk as it was after the last.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from aquaflow.base.errors import DamagedError
from aquaflow.base.storage.archive import UNREADABLE, read_facts_file, write_facts_file
from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes.place import PlacesFile
from aquaflow.survey.site.frames import component_of, log_growth
from aquaflow.survey.site.links import LINK
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph
from aquaflow.tracking.graph.table import EDGE, NODE, TRUST

LEAST_TRUST = 0.5
"""Of a loop within a dive that is taken over, as in ``tracking/graph/optimisation.py``."""
BRIDGE_SIGMA = 0.1
"""1 sigma of the relative pose of consecutive keyframes that no edge joins any more, because a
keyframe between them was lost: in median depths, rad and log-scale. Judgement: ten times what a
link along the path has."""
SCALE_KEPT = 0.1
"""Sigmas of a world's scale by which the mean of its dives' scales may differ from it: less is not
worth moving everything."""

HELD = 1e-3
"""Move of a keyframe below which it is not shown: in units of the keyframe (about its depth), rad
and log-scale. Each dive that is added moves all others by less and less; who works with a site's
world wants it to stay, and what stays is not written again. Judgement: a tenth of what is known of
how dives of a site lie to each other."""

Verdict = Literal["alone", "used", "contradicts the others", "contradicts the graph"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
ALONE, USED, AGAINST_OTHERS, AGAINST_GRAPH = range(len(VERDICTS))
"""Numbers of verdicts in the table of links."""

JOINT_LINK = np.dtype(
    [
        ("node_a", "<i8"),
        ("node_b", "<i8"),
        ("edge", "<i8"),
        ("verdict", "u1"),
        *((name, LINK[name]) for name in LINK.names or () if name != "dive"),
    ]
)
"""A link between keyframes of two dives: their nodes, its edge in the graph (-1: none), and the
number of the verdict on it."""
START = np.dtype(
    [
        ("dive", "<i4"),
        ("number", "<i8"),
        ("sub_map", "<i4"),
        ("t_ns", "<i8"),
        ("R", "<f8", (3, 3)),
        ("t", "<f8", (3,)),
        ("scale", "<f8"),
    ]
)
"""A keyframe as its dive has it: index of the dive, its number and sub-map there, and T_nc, with
the scale that takes its unit to that of n."""


@dataclass(frozen=True)
class SubMap:
    """A sub-map of one of the site's dives; its nodes are numbered through."""

    dive: int
    """Index of the dive."""
    number: int
    """Of the sub-map in its dive."""
    frame: WorldFrame
    first: int
    """Node of its first keyframe."""
    start: Rows
    """[K] START: its keyframes in order."""

    @property
    def nodes(self) -> slice:
        """Its nodes."""
        return slice(self.first, self.first + len(self.start))

    @cached_property
    def starts(self) -> Sim3Batch:
        """[K] T_nc of the keyframes."""
        return poses_of(self.start)


def by_knowledge(sub_map: SubMap) -> tuple[object, ...]:
    """Key for sorting: the sub-map in whose world others are expressed comes first."""
    frame = sub_map.frame
    known = (frame.georeferenced, frame.metric and frame.level, frame.metric, frame.level)
    sigma = frame.scale_sigma if frame.metric else 0.0
    return (*(not each for each in known), sigma, sub_map.first)


class JointGraph:
    """Nodes are numbered through: dive after dive, sub-map after sub-map, keyframe after
    keyframe."""

    def __init__(self) -> None:
        self.graph = PoseGraph()
        self.dives: list[str] = []
        """Fingerprints in the order of adding."""
        self.sub_maps: list[SubMap] = []
        self.links: Rows = np.zeros(0, JOINT_LINK)
        """[L] JOINT_LINK: every link that was found."""
        self.shown: Rows = np.zeros(0, NODE)
        """[N] NODE: the keyframes as they are shown: T_sc, and their components."""
        self.settled_nodes = self.settled_edges = 0
        """How many there were when all were optimised together."""
        self._node: dict[tuple[int, int], int] = {}
        self._sub_map_of: list[int] = []

    def add(self, dive: str, file: PlacesFile, frames: Mapping[int, WorldFrame]) -> None:
        """Add the dive with the fingerprint ``dive``; ``frames``: of its sub-maps."""
        index, rows = len(self.dives), []
        for place in sorted(file.places, key=lambda each: (each.sub_map, each.number)):
            T_nc = frames.get(place.sub_map, WorldFrame.unknown()).T_nm @ place.T_mc
            where = (index, place.number, place.sub_map, place.t_ns)
            rows.append((*where, T_nc.R, T_nc.t, T_nc.scale))
        self.dives.append(dive)
        for sub_map in self._append(np.array(rows, START) if rows else np.zeros(0, START), frames):
            for node, T in enumerate(self._starts(sub_map), sub_map.first):
                self.graph.add_keyframe(node, T)
        for row in file.edges:
            a, b = (self._node[index, int(row[end])] for end in ("a", "b"))
            if row["trust"] >= LEAST_TRUST and self._sub_map_of[a] == self._sub_map_of[b]:
                self._add_edge(a, b, np.array(row["information"]))
        for sub_map in self.sub_maps:
            if sub_map.dive == index:
                self._add_bridges(sub_map)

    def node(self, dive: int, keyframe: int) -> int:
        """Number of a keyframe's node."""
        return self._node[dive, keyframe]

    def first_node_of(self, dive: int) -> int:
        """The first node of a dive, by its index; without keyframes the one that would follow."""
        nodes = [each.first for each in self.sub_maps if each.dive == dive]
        return min(nodes, default=len(self._sub_map_of))

    def dive_of(self, node: int) -> int:
        """Index of the dive that a node belongs to."""
        return self.sub_maps[self._sub_map_of[node]].dive

    def components(self) -> list[list[int]]:
        """The sub-maps of each component, by index, that which knows most first."""
        component = self.graph.tables()["nodes"]["component"]
        members: dict[int, list[int]] = {}
        for index, sub_map in enumerate(self.sub_maps):
            members.setdefault(int(component[sub_map.first]), []).append(index)
        for indices in members.values():
            indices.sort(key=lambda index: by_knowledge(self.sub_maps[index]))
        return list(members.values())

    def poses(self, sub_map: int) -> Sim3Batch:
        """[K] T_sc of the sub-map's keyframes as the graph has them now."""
        return poses_of(self.graph.tables()["nodes"][self.sub_maps[sub_map].nodes])

    def growth(self, sub_maps: Sequence[int]) -> list[float]:
        """Mean logarithm of how much each was enlarged against its own world."""
        return [log_growth(self.sub_maps[i].starts, self.poses(i)) for i in sub_maps]

    def settle_worlds(self) -> None:
        """Express each component in the world of the sub-map that knows most, with the mean scale
        of all; those that are so already stay."""
        for indices in self.components():
            first = self.sub_maps[indices[0]]
            T_sn = Sim3.identity()
            if self.graph.component_of(first.first) != first.first:
                T_sn = self._starts(first)[0] @ self.graph.pose(first.first).inverse()
            growth = np.array(self.growth(indices)) - np.log(T_sn.scale)
            frames = [self.sub_maps[index].frame for index in indices]
            component, factor = component_of(indices, frames, growth.tolist())
            frame = component.frame
            if not frame.metric or abs(np.log(factor)) <= SCALE_KEPT * frame.scale_sigma:
                factor = 1.0
            move = Sim3(np.eye(3), np.zeros(3), factor) @ T_sn
            if self.graph.component_of(first.first) != first.first or factor != 1.0:
                self.graph.move_component(first.first, move)

    def show(self) -> None:
        """Show the keyframes as they are, but for sub-maps that lie where they are shown to
        ``HELD``."""
        nodes, before = self.graph.tables()["nodes"].copy(), self.shown
        count = len(before)
        if not count:
            self.shown = nodes
            return
        moved = np.abs((poses_of(before).inverse() @ poses_of(nodes[:count])).log()).max(axis=1)
        moved[before["component"] != nodes["component"][:count]] = np.inf
        for sub_map in self.sub_maps:
            if sub_map.nodes.stop <= count and moved[sub_map.nodes].max() <= HELD:
                nodes[sub_map.nodes] = before[sub_map.nodes]
        self.shown = nodes

    def _append(
        self,
        start: Rows,  # [K]
        frames: Mapping[int, WorldFrame],
    ) -> list[SubMap]:
        """Sub-maps of the keyframes ``start`` of one dive, in order."""
        new: list[SubMap] = []
        for number in np.unique(start["sub_map"]).tolist():
            rows, first = start[start["sub_map"] == number], len(self._sub_map_of)
            frame = frames.get(number, WorldFrame.unknown())
            new.append(SubMap(int(rows["dive"][0]), number, frame, first, rows))
            for node, row in enumerate(rows, first):
                self._node[int(row["dive"]), int(row["number"])] = node
            self._sub_map_of += [len(self.sub_maps)] * len(rows)
            self.sub_maps.append(new[-1])
        return new

    def _starts(self, sub_map: SubMap) -> list[Sim3]:
        return [sub_map.starts.element(i) for i in range(len(sub_map.start))]

    def _add_edge(
        self,
        a: int,
        b: int,
        information: np.ndarray,  # [7, 7]
    ) -> None:
        T_ab = self.graph.pose(a).inverse() @ self.graph.pose(b)
        self.graph.add_edge(Edge(a, b, T_ab, information))

    def _add_bridges(self, sub_map: SubMap) -> None:
        nodes = range(sub_map.first, sub_map.first + len(sub_map.start))
        for before, after in pairwise(nodes):
            if self.graph.component_of(before) != self.graph.component_of(after):
                self._add_edge(after, before, np.eye(7) / BRIDGE_SIGMA**2)


# --------------------------------------------------------------------------------------------------
# ``joint.npz``: the joint graph as the last merge left it.

NAME = "joint.npz"
"""In a site's folder."""
FORMAT = 1
"""Raised whenever the same dives and links would give another graph."""
MOST_BYTES = 1 << 31
"""Of a graph: a keyframe takes 230 bytes, a link 1.5 kB."""
_DTYPES = {
    "nodes": NODE, "edges": EDGE, "trust": TRUST, "links": JOINT_LINK, "start": START,
    "shown": NODE,
}  # fmt: skip


def write_joint(site: Path, joint: JointGraph) -> None:
    """Write the graph into the site's folder.

    Raises:
        InputError: the file cannot be written.
    """
    start = [np.zeros(0, START), *(sub_map.start for sub_map in joint.sub_maps)]
    tables = joint.graph.tables() | {"links": joint.links, "start": np.concatenate(start)}
    tables |= {"shown": joint.shown}
    settled = [joint.settled_nodes, joint.settled_edges]
    about = {"format": FORMAT, "dives": joint.dives, "settled": settled}
    write_facts_file(site / NAME, about, tables)


def read_joint(site: Path, frames: Mapping[str, Mapping[int, WorldFrame]]) -> JointGraph | None:
    """The graph in the site's folder; None where there is none of dives that all are among those of
    ``frames``, their frames by fingerprint."""
    try:
        about, arrays = read_facts_file(site / NAME, most_bytes=MOST_BYTES)
        dives = [str(each) for each in about["dives"]]
        if about["format"] != FORMAT or not set(dives) <= frames.keys():
            return None
        _check(arrays, len(dives))
        joint, start = JointGraph(), arrays["start"]
        joint.dives, joint.links, joint.shown = dives, arrays["links"], arrays["shown"]
        joint.settled_nodes, joint.settled_edges = map(int, about["settled"])
        for index, dive in enumerate(dives):
            joint._append(start[start["dive"] == index], frames[dive])
        edges = len(arrays["edges"])
        joint.graph = PoseGraph.of_tables(arrays, GraphConfig(), settled=edges)
        return joint
    except (*UNREADABLE, AttributeError):
        return None


def _check(
    arrays: Mapping[str, Rows],  # each [N]
    dives: int,
) -> None:
    if any(
        arrays[name].dtype != dtype or arrays[name].ndim != 1 for name, dtype in _DTYPES.items()
    ):
        raise DamagedError("a table is none")
    nodes, edges, links, start = (arrays[name] for name in ("nodes", "edges", "links", "start"))
    count = len(nodes)
    numbered = (nodes["number"] == np.arange(count)).all() and len(start) == count
    numbered = numbered and len(arrays["shown"]) == count
    if not numbered or len(arrays["trust"]) != len(edges) or (np.diff(start["dive"]) < 0).any():
        raise DamagedError("its tables do not fit together")
    ends = [edges["a"], edges["b"], links["node_a"], links["node_b"], nodes["component"]]
    if any(((each < 0) | (each >= count)).any() for each in ends):
        raise DamagedError("it joins keyframes that are not there")
    if (links["edge"] >= len(edges)).any() or (links["verdict"] >= len(VERDICTS)).any():
        raise DamagedError("a link is none")
    if ((start["dive"] < 0) | (start["dive"] >= dives)).any():
        raise DamagedError("a keyframe is of no dive")
    for rows in (nodes, edges, start, links, arrays["shown"]):
        if not all(np.isfinite(rows[name]).all() for name in ("R", "t", "scale")):
            raise DamagedError("a pose is not finite")
