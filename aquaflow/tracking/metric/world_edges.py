"""Telemetry as edges of the keyframe graph: from the world to single keyframes.

The world n becomes a node of its own, whose pose T_mn the optimisation finds with the keyframes'.
Its edge to a keyframe says what telemetry measured there: the depth, where down and north are, the
scale that a DVL's displacement gives, a fix. In all other directions it has no information, and
there the measured pose is the present one. So scale drift along a dive is pulled straight by the
same solver that closes loops (Eq. 4), and no other equation is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class KeyframeMeasurements:
    """What telemetry says of one keyframe; None where it says nothing."""

    depth_m: tuple[float, float] | None = None
    """z of the camera in n, and 1 sigma."""
    turn: Array | None = None
    """[3] rad, from the present orientation to the measured one, in the axes of n."""
    turn_sigma: tuple[float, float] = (0.0, 0.0)
    """1 sigma of down and of north, rad; infinite for a north that is not measured."""
    scale: tuple[float, float] | None = None
    """Metres per unit of the keyframe, and relative 1 sigma."""
    place_m: tuple[Array, float] | None = None
    """[2] north and east of the camera in n, and 1 sigma of each."""


@dataclass(frozen=True)
class WorldEdge:
    """The measured pose of a keyframe in n, with information only where something was measured."""

    keyframe: int
    T_nk: Sim3
    information: Array
    """[7, 7] of the right tangent of ``T_nk``."""
    chi2: float
    """Squared difference to the present pose, in sigmas."""
    count: int
    """Numbers that were measured."""


def world_edge(
    keyframe: int,
    T_nk: Sim3,
    measured: KeyframeMeasurements,
) -> WorldEdge | None:
    """The edge to a keyframe that is at ``T_nk`` now; None if nothing was measured.

    A step d = [u, w, q] of the keyframe, T exp(d), moves its place by scale R u, turns it by R w
    in the axes of n, and changes the logarithm of its scale by q.
    """
    t, R, scale = T_nk.t.copy(), T_nk.R, T_nk.scale
    rows: list[Array] = []
    if measured.depth_m is not None:
        t[2], sigma = measured.depth_m
        rows.append(_moves(2, T_nk) / sigma)
    if measured.place_m is not None:
        t[:2], sigma = measured.place_m
        rows += [_moves(axis, T_nk) / sigma for axis in (0, 1)]
    if measured.turn is not None:
        sigmas = (measured.turn_sigma[0], measured.turn_sigma[0], measured.turn_sigma[1])
        known = np.isfinite(sigmas)
        R = so3_exp(np.where(known, measured.turn, 0.0)) @ R
        rows += [_turns(axis, T_nk) / sigmas[axis] for axis in range(3) if known[axis]]
    if measured.scale is not None:
        scale, sigma = measured.scale
        rows.append(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0 / sigma]))
    if not rows:
        return None
    A, T_measured = np.stack(rows), Sim3(R, t, scale)
    apart = A @ (T_measured.inverse() @ T_nk).log()
    return WorldEdge(keyframe, T_measured, A.T @ A, float(apart @ apart), len(rows))


def _moves(axis: int, T_nk: Sim3) -> Array:
    """[7] how a step moves the keyframe along an axis of n."""
    return np.concatenate([T_nk.scale * T_nk.R[axis], np.zeros(4)])


def _turns(axis: int, T_nk: Sim3) -> Array:
    """[7] how a step turns the keyframe about an axis of n."""
    return np.concatenate([np.zeros(3), T_nk.R[axis], np.zeros(1)])


@dataclass(frozen=True)
class World:
    """The world of one component of the graph, and its edges."""

    component: int
    T_mn: Sim3
    edges: Sequence[WorldEdge]
    of_base: bool = False
    """True for the world of an earlier dive, beside that of telemetry."""

    @property
    def number(self) -> int:
        """Of its node: negative, and no other's."""
        return -2 - 2 * self.component if self.of_base else -1 - 2 * self.component

    @property
    def strain(self) -> float:
        """Mean of the squared differences, in sigmas: 1 where path and telemetry agree."""
        return sum(e.chi2 for e in self.edges) / max(sum(e.count for e in self.edges), 1)

    @staticmethod
    def at(component: int, frame: WorldFrame, edges: Sequence[WorldEdge]) -> World:
        """At the frame that the estimator found."""
        return World(component, frame.T_nm.inverse(), edges)
