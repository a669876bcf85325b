"""The keyframe graph solved together with telemetry: frames of all sub-maps, and their worlds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from aquaflow.fusion.estimator import Estimate, estimate
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.graph.optimisation import Optimisation
from aquaflow.tracking.graph.table import EDGE, NODE, TRUST, GraphResult, Snapshot
from aquaflow.tracking.metric.measured import world_edges
from aquaflow.tracking.metric.survey import Survey
from aquaflow.tracking.metric.world_edges import World


def estimates_of(survey: Survey) -> dict[int, Estimate]:
    """The metric frame of every component of the graph, by its first keyframe."""
    found: dict[int, Estimate] = {}
    for component in survey.components():
        path = survey.path(component)
        found[component] = estimate(
            survey.telemetry, path, survey.config, survey.mounting,
            lambda component=component: survey.ground(component),
        )  # fmt: skip
    return found


def straightened(snapshot: Snapshot, survey: Survey, t_s: Mapping[int, float]) -> GraphResult:
    """Optimise a snapshot together with what telemetry says of its keyframes.

    ``t_s``: moment of each keyframe, by number. Reads nothing else, and changes nothing.
    """
    nodes, worlds = snapshot.nodes, []
    for component, found in estimates_of(survey).items():
        inside = nodes[nodes["component"] == component]
        numbers = inside["number"]
        moments = np.array([t_s[number] for number in numbers.tolist()])
        edges = world_edges(found, numbers, moments, poses_of(inside))
        if edges:
            worlds.append(World.at(component, found.frame, edges))
    return solve_with_worlds(snapshot, worlds)


def solve_with_worlds(snapshot: Snapshot, worlds: list[World]) -> GraphResult:
    """Optimise keyframes and worlds; the result is of the keyframes alone."""
    edges, count = len(snapshot.edges), len(snapshot.nodes)
    result = Optimisation(_with_worlds(snapshot, worlds), everything=False).run()
    own = result.rows < count
    poses = {number: T for number, T in result.poses.items() if number >= 0}
    return replace(
        result,
        poses=poses,
        trust={edge: trust for edge, trust in result.trust.items() if edge < edges},
        snapshot=snapshot,
        rows=result.rows[own],
        solved=result.solved[own],
        edge_trust=result.edge_trust[:edges],
    )


def _with_worlds(snapshot: Snapshot, worlds: list[World]) -> Snapshot:
    """The snapshot with a node for every world, whose number is negative, and its edges."""
    row = {int(number): i for i, number in enumerate(snapshot.nodes["number"])}
    nodes = np.zeros(len(worlds), NODE)
    edges = np.zeros(sum(len(world.edges) for world in worlds), EDGE)
    k = 0
    for i, world in enumerate(worlds):
        T = world.T_mn
        nodes[i] = (-1 - world.component, world.component, T.R, T.t, T.scale)
        for edge in world.edges:
            edges[k]["a"], edges[k]["b"] = len(snapshot.nodes) + i, row[edge.keyframe]
            edges[k]["R"], edges[k]["t"], edges[k]["scale"] = (
                edge.T_nk.R,
                edge.T_nk.t,
                edge.T_nk.scale,
            )
            edges[k]["information"] = edge.information
            k += 1
    trust = np.zeros(len(edges), TRUST)
    trust["trust"], trust["allowed"] = 1.0, snapshot.config.loop_chi2
    return replace(
        snapshot,
        nodes=_joined(snapshot.nodes, nodes),
        edges=_joined(snapshot.edges, edges),
        trust=_joined(snapshot.trust, trust),
    )


def _joined(
    first: Rows,  # [n]
    second: Rows,  # [m] of the same dtype
) -> Rows:
    return np.concatenate([first, second])
