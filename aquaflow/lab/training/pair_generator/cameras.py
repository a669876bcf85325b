"""Cameras of a pair: intrinsics of real ones, and a relative motion from small to very wide."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.scene import Terrain, rotation


@dataclass(frozen=True)
class PairMotion:
    """How far the second camera is from the first."""

    baseline: float = 0.45
    """Largest, as a share of the scene's median depth."""
    power: float = 1.5
    """Above 1 favours short baselines."""
    tilt: float = 0.08
    """Radians, deviation about either axis of the picture."""
    roll: float = 0.15
    """Radians, deviation about the optical axis."""
    forward: float = 0.0
    """Share of the pairs that move along the optical axis, to the front or back."""


TRAINING = PairMotion(baseline=0.8, forward=0.25)
"""Of the pairs that are learned from: wider than what is held out, and a quarter along the axis."""
WIDE = PairMotion(baseline=0.45, power=1.5, tilt=0.07, roll=0.12)
"""Of the held-out pairs: the motion of the prototypes' measurements (notes/2026-11-priors.md)."""
WIDER = PairMotion(baseline=0.45, power=1.0, tilt=0.1, roll=0.2)
"""Of a second held-out set: every baseline as likely as another, and more roll."""

FIELD_OF_VIEW_DEG = (40.0, 95.0)
"""Horizontal: a narrow inspection camera to an action camera, both in water."""
ALTITUDE_M = (0.8, 3.0)
"""Of the first camera above the floor."""
PITCH_DEG = (12.0, 90.0)
"""Below the horizon: from looking forward to looking down."""
CLEARANCE_M = 0.25
"""Of the second camera above the floor."""
LOOKS_BACK = 0.6
"""Share of the second cameras that turn towards what the first one looks at."""
OFF_AXIS = 0.15
"""Length across the optical axis of a motion along it, as a share of its length, deviation."""
MOST_FORWARD = 0.5
"""Of the scene's median depth, towards it: twice as near shows everything twice as large."""


def intrinsics(
    draw: Draw,
    batch: int,
    width: int,
    height: int,
    fov_deg: tuple[float, float] = FIELD_OF_VIEW_DEG,
) -> Tensor:
    """[B, 3, 3] px, pixel centres at half-integers."""
    fov = torch.deg2rad(draw.uniform(batch, low=fov_deg[0], high=fov_deg[1]))
    focal = width / 2.0 / torch.tan(fov / 2.0)
    K = torch.zeros(batch, 3, 3, device=draw.device)
    K[:, 0, 0], K[:, 1, 1] = focal, focal * draw.uniform(batch, low=0.97, high=1.03)
    K[:, 0, 2] = width * draw.uniform(batch, low=0.47, high=0.53)
    K[:, 1, 2] = height * draw.uniform(batch, low=0.47, high=0.53)
    K[:, 2, 2] = 1.0
    return K


def first_camera(draw: Draw, terrain: Terrain) -> Tensor:
    """[B, 4, 4] camera to world; x right, y down, z forward."""
    batch = len(terrain.period)
    place = draw.uniform(batch, 2, low=-1.5, high=1.5)
    floor = torch.maximum(
        terrain.height(place[:, None])[:, 0], terrain.field[:, 0].mean(dim=(1, 2))
    )
    altitude = draw.uniform(batch, low=ALTITUDE_M[0], high=ALTITUDE_M[1])
    pitch = torch.deg2rad(draw.uniform(batch, low=PITCH_DEG[0], high=PITCH_DEG[1]))
    yaw = draw.uniform(batch, high=2.0 * math.pi)
    level = torch.zeros_like(yaw)
    forward = torch.stack([yaw.cos() * pitch.cos(), yaw.sin() * pitch.cos(), -pitch.sin()], -1)
    right = torch.stack([yaw.sin(), -yaw.cos(), level], -1)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
    roll = torch.stack([level, level, draw.normal(batch, sigma=0.3)], -1)
    return _pose(R @ rotation(roll), torch.cat([place, (floor + altitude)[:, None]], -1))


def second_camera(
    draw: Draw,
    terrain: Terrain,
    T_wc: Tensor,  # [B, 4, 4] of the first
    depth: Tensor,  # [B] m, median of what the first sees
    motion: PairMotion,
) -> Tensor:
    """[B, 4, 4] camera to world."""
    T = moved_camera(draw, T_wc, depth, motion)
    centre = T[:, :3, 3]
    floor = terrain.height(centre[:, None, :2])[:, 0] + CLEARANCE_M
    centre = torch.cat([centre[:, :2], torch.maximum(centre[:, 2], floor)[:, None]], -1)
    return _pose(T[:, :3, :3], centre)


def moved_camera(
    draw: Draw,
    T_wc: Tensor,  # [B, 4, 4] of the first
    depth: Tensor,  # [B] m, median of what the first sees
    motion: PairMotion,
) -> Tensor:
    """[B, 4, 4] camera to world, wherever that is."""
    batch = len(T_wc)
    length = draw.uniform(batch, 1) ** motion.power * motion.baseline * depth[:, None]
    step = F.normalize(draw.normal(batch, 3), dim=-1) * length
    if motion.forward > 0.0:
        along = _along_axis(draw, length).clamp_max(MOST_FORWARD * depth[:, None])
        step = torch.where(draw.chance(motion.forward, batch, 1), along, step)
    sigma = torch.tensor([motion.tilt, motion.tilt, motion.roll], device=draw.device)
    turn = draw.normal(batch, 3) * sigma
    towards = torch.stack([step[:, 1], -step[:, 0], torch.zeros_like(depth)], -1)
    turn = turn + towards / depth[:, None] * draw.chance(LOOKS_BACK, batch, 1)
    R = T_wc[:, :3, :3]
    centre = T_wc[:, :3, 3] + (R @ step[..., None])[..., 0]
    return _pose(R @ rotation(turn), centre)


def _along_axis(
    draw: Draw,
    length: Tensor,  # [B, 1] m
) -> Tensor:
    """[B, 3] m in the camera's frame, half of them to the back."""
    across = draw.normal(len(length), 2, sigma=OFF_AXIS)
    way = torch.where(draw.chance(0.5, len(length), 1), 1.0, -1.0)
    return torch.cat([across, way], -1) * length


def _pose(
    R: Tensor,  # [B, 3, 3]
    centre: Tensor,  # [B, 3]
) -> Tensor:
    T = torch.eye(4, device=R.device).repeat(len(R), 1, 1)
    T[:, :3, :3], T[:, :3, 3] = R, centre
    return T
