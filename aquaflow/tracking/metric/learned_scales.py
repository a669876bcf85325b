"""A learned prior against drift of scale: its unit is the same from the first picture to the last.

The unit of a keyframe's depths drifts along a dive by a little at every link. A network errs by
much more, but one whose unit is the same everywhere by as much in the last picture as in the first.
So what it says of the unit of every
keyframe is an edge to a world whose unit is the network's (``world_edges``), with the error that
the differences between keyframes a few links apart show. Only a drift beyond that error moves
anything; where telemetry knows the scale, the network is not asked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, isfinite

import numpy as np
import numpy.typing as npt

from aquaflow.config.tracking import LearnedConfig
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes import KeyframeStore
from aquaflow.optimise.robust import sigma_of
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.graph.table import GraphResult, Snapshot
from aquaflow.tracking.metric.straightening import solve_with_worlds
from aquaflow.tracking.metric.world_edges import KeyframeMeasurements, World, WorldEdge, world_edge

Array = npt.NDArray[np.float64]

LEAST_KEYFRAMES = 20
"""Of a component, before which its scales are too few to tell drift from error."""
EVERY = 10
"""Keyframes between two looks at the scales."""
APART = 5
"""Keyframes whose scales are compared: nearer ones show the same scene, and the network errs alike;
a drift of a percent a link changes the median of the differences and not their spread."""
STRAIN = 1.5
"""Mean squared difference of the scales, in sigmas, up to which they stay as they are
(``straightening``)."""
HELD = 1e-3
"""rad, and units of the first keyframe, that it is held to: the network knows no place."""


@dataclass(frozen=True)
class _Scales:
    """What the network says of the scales of one component."""

    rows: npt.NDArray[np.intp]
    """[K] of the snapshot's nodes"""
    excess: Array
    """[K] logarithm of the component's unit over the network's, by each keyframe"""
    sigma: Array
    """[K]"""

    @property
    def middle(self) -> float:
        """Logarithm of the component's unit over the network's."""
        return float(np.median(self.excess))

    @property
    def strain(self) -> float:
        """Mean squared difference from the median, in sigmas: 1 without drift."""
        return float((((self.excess - self.middle) / self.sigma) ** 2).mean())


class LearnedScales:
    """Takes part in the graph's optimisations, as telemetry does."""

    def __init__(self, keyframes: KeyframeStore, unit_sigma: float) -> None:
        """Of keyframes whose pointmaps say what the network's unit is; ``unit_sigma`` is what that
        may differ by from one part of a dive to another (`Prior.unit_sigma`)."""
        self._keyframes, self._unit_sigma = keyframes, unit_sigma
        self._known: dict[int, tuple[float, float]] = {}
        """By keyframe: logarithm of its unit over the network's, and 1 sigma."""
        self._since = 0

    @property
    def present(self) -> bool:
        """True once enough keyframes have a scale."""
        return len(self._known) >= LEAST_KEYFRAMES

    def keyframe(self, number: int, parent: int | None) -> bool:
        """A new keyframe; True if it is time to look at the scales."""
        found = self._keyframes[number].pointmap.learned
        if found is not None:
            self._known[number] = found.log_scale, found.log_scale_sigma
        self._since += 1
        if self._since < EVERY or not self.present:
            return False
        self._since = 0
        return True

    def job(self, snapshot: Snapshot) -> Callable[[Snapshot], GraphResult]:
        """The optimisation of a snapshot with the scales, to be called in any thread."""
        known = {n: (log, hypot(s, self._unit_sigma)) for n, (log, s) in self._known.items()}
        return lambda better: solve_with_worlds(better, worlds_of(better, known))[0]

    def apply(self) -> None:
        """Nothing is kept of a result."""


def learned_scales(
    keyframes: KeyframeStore, unit_sigma: float, config: LearnedConfig
) -> LearnedScales | None:
    """None where they are not wanted, or the network has no unit that lasts."""
    return LearnedScales(keyframes, unit_sigma) if config.scale and isfinite(unit_sigma) else None


def worlds_of(
    snapshot: Snapshot,
    known: dict[int, tuple[float, float]],
) -> list[World]:
    """The world of each component whose scales have drifted by more than the network errs."""
    worlds = []
    for component in np.unique(snapshot.nodes["component"]).tolist():
        scales = _scales(snapshot.nodes, component, known)
        if scales is not None and scales.strain > STRAIN:
            worlds.append(_world(snapshot.nodes, component, scales))
    return worlds


def _scales(
    nodes: Rows,  # [N] NODE
    component: int,
    known: dict[int, tuple[float, float]],
) -> _Scales | None:
    inside = np.flatnonzero(nodes["component"] == component)
    inside = inside[np.argsort(nodes["number"][inside])]
    rows = np.array([row for row in inside if int(nodes["number"][row]) in known], dtype=np.intp)
    if len(rows) < LEAST_KEYFRAMES:
        return None
    found = np.array([known[int(number)] for number in nodes["number"][rows]])
    excess = np.log(nodes["scale"][rows]) + found[:, 0]
    change = excess[APART:] - excess[:-APART]
    spread = sigma_of(change - np.median(change)) / 2.0**0.5
    return _Scales(rows, excess, np.hypot(found[:, 1], spread))


def _world(
    nodes: Rows,  # [N] NODE
    component: int,
    scales: _Scales,
) -> World:
    """Its edges say the scale of every keyframe, and where the first is."""
    T_mn = Sim3(np.eye(3), np.zeros(3), float(np.exp(scales.middle)))
    to_n = Sim3Batch.of([T_mn.inverse()])
    edges: list[WorldEdge] = []
    first = int(np.flatnonzero(nodes["number"] == component)[0])
    T_first = (to_n @ poses_of(nodes[first : first + 1])).element(0)
    held = HELD * T_first.scale
    gauge = KeyframeMeasurements(
        depth_m=(float(T_first.t[2]), held),
        place_m=(T_first.t[:2], held),
        turn=np.zeros(3),
        turn_sigma=(HELD, HELD),
    )
    edge = world_edge(component, T_first, gauge)
    edges += [] if edge is None else [edge]
    T_nk = to_n @ poses_of(nodes[scales.rows])
    for k, row in enumerate(scales.rows.tolist()):
        T, excess = T_nk.element(k), scales.excess[k] - scales.middle
        measured = KeyframeMeasurements(
            scale=(T.scale * float(np.exp(-excess)), float(scales.sigma[k]))
        )
        edge = world_edge(int(nodes["number"][row]), T, measured)
        edges += [] if edge is None else [edge]
    return World(component, T_mn, edges)
