"""Vehicles that move along a known way, as a camera on them and a map of any scale have it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.live.vehicle.body_track import BodyPoseInWorld
from aquaflow.live.vehicle.pose_output import PoseOutput
from aquaflow.telemetry.start import camera_in_body
from aquaflow.telemetry.world_frame import North, WorldFrame
from aquaflow.tracking.frames import FrameClass, Quality, Tracked
from tests.live.live_scenes import Told, frame_of

MOUNTINGS = {
    "forward": MountingConfig(position_m=(0.2, 0.0, 0.1)),
    "down": MountingConfig(position_m=(0.1, 0.05, 0.15), pitch_deg=-90.0),
    "upside down": MountingConfig(position_m=(0.2, 0.0, 0.1), roll_deg=180.0),
}
T_NM = Sim3(so3_exp(np.array([0.4, -1.1, 0.7])), np.array([3.0, -2.0, 1.5]), 2.05)
"""A map whose unit is 2.05 m, and whose axes are anything but level."""


def frame(mounting: str | None = "forward", scale_sigma: float = 0.01) -> WorldFrame:
    """The map's place in the world, well known."""
    sigmas = np.array([0.05, 0.05, 0.02, 0.005, 0.005, 0.02, scale_sigma])
    T_bc = None if mounting is None else camera_in_body(MOUNTINGS[mounting])
    north: North = "magnetic north"
    return WorldFrame(
        T_NM, np.diag(sigmas**2), metric=True, level=True, north=north, T_bc=T_bc,
        scale_source="autopilot",
    )  # fmt: skip


def turned(known: WorldFrame, xi: Sequence[float]) -> WorldFrame:
    """The same with a place that a new estimate moved by a tangent vector."""
    return replace(known, T_nm=Sim3.exp(np.array(xi)) @ known.T_nm)


def diving(seconds: np.ndarray) -> list[BodyPoseInWorld]:
    """A vehicle that swims ahead at 0.5 m/s, turns at 0.3 rad/s and descends at 0.275 m/s."""
    poses = []
    for s in seconds:
        heading = 0.8 + 0.3 * s
        R = so3_exp(np.array([0.0, 0.0, heading]))
        ahead = 0.5 / 0.3 * np.array([np.sin(heading) - np.sin(0.8), np.cos(0.8) - np.cos(heading)])
        poses.append(BodyPoseInWorld(R, np.array([*ahead, 0.275 * s])))
    return poses


def seen(pose: BodyPoseInWorld, known: WorldFrame, mounting: str = "forward") -> Sim3:
    """The camera's pose in the map."""
    T_nb = Sim3(pose.R, pose.t_m)
    return known.T_nm.inverse() @ T_nb @ camera_in_body(MOUNTINGS[mounting])


def show(
    told: Told, out: PoseOutput, T_mc: Sim3, t_ns: int | None = None, sub_map: int = 0,
    hz: float = 10.0, quality: float = 0.8,
) -> None:  # fmt: skip
    """One frame of the loop that has a pose."""
    index = told.loop.counters.frames
    told.loop.counters.frame(0)
    picture = frame_of(index)
    picture = replace(picture, t_ns=round(1e9 * index / hz) if t_ns is None else t_ns)
    rated = Quality(inlier_share=quality)
    told.loop.latest = Tracked(picture, FrameClass.COMMON, sub_map, 0, T_mc, rated)
    out.update(told.loop, 1000.0 + index / hz)
