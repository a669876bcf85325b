"""What the estimator needs of a dive at one moment, so that another thread may work on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.arrays import to_sim3
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.keyframes import Pointmap
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.tracking.graph.equations import Rows, poses_of
from aquaflow.tracking.metric.sightings import LengthSightings, SeenLengths

Array = npt.NDArray[np.float64]

POINTS_OF_KEYFRAME = 600
"""Of each pointmap, for the altimeter's beam."""
MOST_POINTS = 300_000
"""Of a sub-map; a beam looks through all of them."""
KNOWN_SIGMA = 0.1
"""Relative 1 sigma of a pixel's depth that counts as ground."""


@dataclass(frozen=True)
class TrackingSnapshot:
    """Read-only: keyframes and frames as they are now, and all telemetry until now."""

    nodes: Rows
    """[K] NODE of the keyframe graph."""
    parts: Sequence[Rows]
    """[n] FRAME: finished frames, in pieces."""
    telemetry: Telemetry
    points: Sequence[Array]
    """[n, 3] of each keyframe by its number, in its own camera frame; empty for some."""
    mounting: MountingConfig | None
    config: FusionConfig
    sightings: LengthSightings

    @cached_property
    def frames(self) -> Rows:
        """[N] FRAME: the same in one piece, put together by the thread that works on them."""
        return np.concatenate(self.parts)

    def components(self) -> list[int]:
        """Sub-maps in the order of their first keyframe, by its number."""
        return [int(number) for number in np.unique(self.nodes["component"])]

    def path(self, component: int) -> CameraPath:
        """The camera's path in a sub-map."""
        row = np.full(int(self.nodes["number"].max(initial=-1)) + 1, -1)
        inside = np.flatnonzero(self.nodes["component"] == component)
        row[self.nodes["number"][inside]] = inside
        posed = self.frames[self.frames["keyframe"] >= 0]
        posed = posed[posed["keyframe"] < len(row)]
        at = row[posed["keyframe"]]
        posed, at = posed[at >= 0], at[at >= 0]
        order = np.argsort(posed["t_ns"], kind="stable")
        posed, at = posed[order], at[order]
        if len(posed) == 0:
            return CameraPath(np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        T_mc = poses_of(self.nodes[at]) @ _similarities(posed["T_kf"])
        t_s, first = np.unique(posed["t_ns"] * 1e-9, return_index=True)
        return CameraPath(t_s, T_mc.R[first], T_mc.t[first])

    def known_lengths(self) -> dict[int, SeenLengths]:
        """What was seen of known size, by component, measured with the poses of now."""
        if not self.sightings:
            return {}
        node = {int(number): row for row, number in enumerate(self.nodes["number"].tolist())}
        frame = {int(index): row for row, index in enumerate(self.frames["index"].tolist())}

        def place_of(frame_index: int) -> tuple[Sim3, int] | None:
            row = self.frames[frame[frame_index]] if frame_index in frame else None
            at = None if row is None else node.get(int(row["keyframe"]))
            if row is None or at is None:
                return None
            T_mk, T_kf = poses_of(self.nodes[at : at + 1]), to_sim3(row["T_kf"])
            return T_mk.element(0) @ T_kf, int(self.nodes["component"][at])

        return self.sightings.measure(place_of)

    def ground(self, component: int) -> Array:
        """[K, 3] points of a sub-map, in its world."""
        inside = self.nodes[self.nodes["component"] == component]
        T_mk = poses_of(inside)
        clouds = [
            T_mk.element(i).apply(self.points[number])
            for i, number in enumerate(inside["number"].tolist())
            if number < len(self.points) and len(self.points[number])
        ]
        cloud = np.concatenate([np.zeros((0, 3)), *clouds])
        return cloud[:: max(1, -(-len(cloud) // MOST_POINTS))]


def sampled_points(pointmap: Pointmap) -> Array:
    """[n, 3] well-known points of a keyframe, evenly over its picture, in its camera frame."""
    known = np.argwhere(pointmap.is_known(KNOWN_SIGMA))
    chosen = known[:: max(1, -(-len(known) // POINTS_OF_KEYFRAME))]
    if len(chosen) == 0:
        return np.zeros((0, 3))
    pixels = chosen[:, ::-1] + 0.5
    rays = pointmap.camera.unproject(pixels)
    return np.asarray(rays / pointmap.rho[chosen[:, 0], chosen[:, 1]][:, None])


def _similarities(
    rows: Array,  # [N, 13] as of storage.arrays.of_sim3
) -> Sim3Batch:
    return Sim3Batch(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:12], rows[:, 12])
