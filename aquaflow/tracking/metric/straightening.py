"""The keyframe graph solved together with telemetry: frames of all sub-maps, and their worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.dead_reckoning import carried_from
from aquaflow.telemetry.estimator import Estimate, estimate
from aquaflow.telemetry.factors.length import length_factors
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.graph.optimisation import Optimisation
from aquaflow.tracking.graph.table import EDGE, NODE, TRUST, GraphResult, Snapshot
from aquaflow.tracking.metric.measured import world_edges
from aquaflow.tracking.metric.sightings import SeenLengths
from aquaflow.tracking.metric.survey import TrackingSnapshot
from aquaflow.tracking.metric.world_edges import World


def estimates_of(survey: TrackingSnapshot) -> dict[int, Estimate]:
    """The metric frame of every component of the graph, by its first keyframe."""
    found: dict[int, Estimate] = {}
    before: tuple[Estimate, CameraPath] | None = None
    measured = survey.known_lengths()
    for component in survey.components():
        path = survey.path(component)
        carried = None
        if before is not None:
            carried = carried_from(*before, survey.telemetry, path)
        known = measured.get(component, SeenLengths([], []))
        found[component] = estimate(
            survey.telemetry, path, survey.config, survey.mounting,
            partial(survey.ground, component), length_factors(known.lengths), carried,
        ).reporting(known.unknown)  # fmt: skip
        if found[component].frame.metric:
            before = found[component], path
    return found


STRAIN = 1.5
"""Mean squared difference of path and telemetry, in sigmas, up to which a sub-map stays as it is:
the camera alone is more precise than any instrument where nothing has drifted."""
LINK_TURN = np.radians(0.05)
"""rad, 1 sigma: links of a synthetic forward view of 164 keyframes turn by 0.02 to 0.08 degrees too
much, root mean square, and mostly the same way; the pose solver's own sigma is 0.01."""
LINK_SHIFT = 0.003
"""1 sigma of a link's translation, over its length, likewise."""


@dataclass(frozen=True)
class Straightened:
    """Keyframes as loops and telemetry want them, and the worlds that they lie in then."""

    result: GraphResult
    frames: dict[int, WorldFrame]
    """By component."""
    strained: bool
    """True if keyframes were pulled to a world; False if they are where they would be without."""


def straighten(
    snapshot: Snapshot,
    survey: TrackingSnapshot,
    t_s: Mapping[int, float],
    bases: Sequence[World] = (),
) -> Straightened:
    """Optimise a snapshot together with what telemetry says of its keyframes.

    ``t_s``: moment of each keyframe, by number; ``bases``: worlds of an earlier dive, in which
    keyframes were recognised. Reads nothing else, and changes nothing.
    """
    nodes, worlds = snapshot.nodes, list(bases)
    estimates = estimates_of(survey)
    for component, found in estimates.items():
        inside = nodes[nodes["component"] == component]
        numbers = inside["number"]
        moments = np.array([t_s[number] for number in numbers.tolist()])
        edges = world_edges(found, numbers, moments, poses_of(inside))
        world = World.at(component, found.frame, edges)
        if world.strain > STRAIN:
            worlds.append(world)
    result, T_mn = solve_with_worlds(snapshot, worlds)
    frames = {component: found.frame for component, found in estimates.items()}
    for component, T in T_mn.items():
        if frames[component].metric:
            frames[component] = replace(frames[component], T_nm=T.inverse())
    return Straightened(result, frames, bool(worlds))


def solve_with_worlds(
    snapshot: Snapshot, worlds: list[World]
) -> tuple[GraphResult, dict[int, Sim3]]:
    """Optimise keyframes and worlds: the result of the keyframes alone, and T_mn by component."""
    if not worlds:
        return Optimisation(snapshot, everything=False).run(), {}
    edges, count = len(snapshot.edges), len(snapshot.nodes)
    result = Optimisation(_with_worlds(snapshot, worlds), everything=False).run()
    own = result.rows < count
    T_mn = {
        world.component: result.poses.get(world.number, world.T_mn)
        for world in worlds
        if not world.of_base
    }
    poses = {number: T for number, T in result.poses.items() if number >= 0}
    keyframes = replace(
        result,
        poses=poses,
        trust={edge: trust for edge, trust in result.trust.items() if edge < edges},
        snapshot=snapshot,
        rows=result.rows[own],
        solved=result.solved[own],
        edge_trust=result.edge_trust[:edges],
    )
    return keyframes, T_mn


def _with_worlds(snapshot: Snapshot, worlds: list[World]) -> Snapshot:
    """The snapshot with a node for every world, whose number is negative, and its edges."""
    row = {int(number): i for i, number in enumerate(snapshot.nodes["number"])}
    nodes = np.zeros(len(worlds), NODE)
    edges = np.zeros(sum(len(world.edges) for world in worlds), EDGE)
    k = 0
    for i, world in enumerate(worlds):
        T = world.T_mn
        nodes[i] = (world.number, world.component, T.R, T.t, T.scale)
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
        nodes=_join(snapshot.nodes, nodes),
        edges=_join(_soften(snapshot.edges) if worlds else snapshot.edges, edges),
        trust=_join(snapshot.trust, trust),
    )


def _soften(
    edges: Rows,  # [M] EDGE
) -> Rows:
    """A copy in which links along the path have the sigmas that they have against the truth."""
    links = ~edges["loop"]
    size = np.linalg.norm(edges["t"][links], axis=1)[:, None]
    least = np.hstack(
        [np.tile(LINK_SHIFT * size, 3), np.full((len(size), 3), LINK_TURN), 0.0 * size]
    )
    soft = edges.copy()
    covariance = edges["covariance"][links] + least[:, :, None] ** 2 * np.eye(7)
    soft["covariance"][links], soft["information"][links] = covariance, np.linalg.inv(covariance)
    return soft


def _join(
    first: Rows,  # [n]
    second: Rows,  # [m] of the same dtype
) -> Rows:
    return np.concatenate([first, second])
