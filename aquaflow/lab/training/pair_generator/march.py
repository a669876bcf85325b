"""Where rays meet a scene: the floor by marching and secant steps, bodies in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.scene import SceneBatch, Solids, Terrain

STEPS = 64
"""Along a ray, each a constant factor further than the last."""
SECANTS = 5
"""Steps that refine where a ray meets the floor."""
NEAREST, FURTHEST = 0.05, 14.0
"""Depths in metres between which something is looked for."""
NOWHERE = 1e6
"""Depth of a ray that meets nothing, metres."""
SLOPE_STEP = 0.02
"""Metres over which the floor's slope is taken."""


@dataclass(frozen=True)
class Hits:
    """What each ray meets first."""

    depth: Tensor
    """[B, N] z along the optical axis, metres; NOWHERE for none"""
    normal: Tensor
    """[B, N, 3] unit, outwards"""
    material: Tensor
    """[B, N] int64, see SceneBatch.materials"""

    @property
    def found(self) -> Tensor:
        """[B, N] bool"""
        return self.depth < FURTHEST


def first_hits(
    scene: SceneBatch,
    centre: Tensor,  # [B, 3] of the camera, metres
    rays: Tensor,  # [B, N, 3] in the world, of unit depth
) -> Hits:
    """The nearest of floor and bodies."""
    depth = _floor(scene.terrain, centre, rays)
    places = (centre[:, None] + depth[..., None].clamp_max(FURTHEST) * rays)[..., :2]
    normal = _slope(scene.terrain, places)
    material = (scene.terrain.rock(places) > 0.5).long()
    for index in range(scene.solids.half.shape[1]):
        t, outwards = _body(scene.solids, index, centre, rays)
        nearer = t < depth
        depth = torch.where(nearer, t, depth)
        normal = torch.where(nearer[..., None], outwards, normal)
        material = torch.where(nearer, 2, material)
    return Hits(depth, normal, material)


def _floor(
    terrain: Terrain,
    centre: Tensor,  # [B, 3] world, m
    rays: Tensor,  # [B, N, 3] world, of unit depth
) -> Tensor:
    """[B, N] depth of the floor along each ray."""
    down = rays[..., 2].clamp_max(-1e-4)
    falls = rays[..., 2] < -1e-4
    low, high = (bound[:, None] - centre[:, 2:] for bound in terrain.bounds)
    start = torch.where(falls, (high + 0.01) / down, NEAREST).clamp(NEAREST, 0.9 * FURTHEST)
    end = torch.where(falls, (low - 0.02) / down, FURTHEST).clamp_max(FURTHEST)
    end = torch.maximum(end, start + 1e-3)
    share = torch.linspace(0.0, 1.0, STEPS, device=rays.device)
    t = start[..., None] * (end / start)[..., None] ** share
    above = _above(terrain, centre, rays, t)
    first = (above < 0.0).float().argmax(-1, keepdim=True).clamp_min(1)
    near, far = t.gather(-1, first - 1)[..., 0], t.gather(-1, first)[..., 0]
    f_near, f_far = above.gather(-1, first - 1)[..., 0], above.gather(-1, first)[..., 0]
    for _ in range(SECANTS):
        middle = near + (far - near) * (f_near / (f_near - f_far + 1e-9)).clamp(0.05, 0.95)
        f = _above(terrain, centre, rays, middle[..., None])[..., 0]
        below = f < 0.0
        far, f_far = torch.where(below, middle, far), torch.where(below, f, f_far)
        near, f_near = torch.where(below, near, middle), torch.where(below, f_near, f)
    met = near + (far - near) * (f_near / (f_near - f_far + 1e-9)).clamp(0.0, 1.0)
    return torch.where((above < 0.0).any(-1), met, NOWHERE)


def _above(
    terrain: Terrain,
    centre: Tensor,  # [B, 3]
    rays: Tensor,  # [B, N, 3]
    t: Tensor,  # [B, N, S]
) -> Tensor:
    """[B, N, S] metres above the floor."""
    places = centre[:, None, None, :2] + t[..., None] * rays[:, :, None, :2]
    height = terrain.height(places.flatten(1, 2)).view_as(t)
    return centre[:, None, 2:] + t * rays[..., 2:] - height


def _slope(
    terrain: Terrain,
    places: Tensor,  # [B, N, 2] metres
) -> Tensor:
    """[B, N, 3] unit normals of the floor."""
    step = torch.eye(2, device=places.device) * SLOPE_STEP
    along = [terrain.height(places + e) - terrain.height(places - e) for e in step]
    tilt = torch.stack(along, -1) / (2.0 * SLOPE_STEP)
    return F.normalize(torch.cat([-tilt, torch.ones_like(tilt[..., :1])], -1), dim=-1)


def _body(
    solids: Solids,
    index: int,
    centre: Tensor,  # [B, 3] world, m
    rays: Tensor,  # [B, N, 3] world, of unit depth
) -> tuple[Tensor, Tensor]:
    """[B, N] depth and [B, N, 3] normal of one body of each scene; NOWHERE where it is missed."""
    R, half = solids.R[:, index], solids.half[:, index, None]
    origin = ((centre - solids.centre[:, index])[:, None] @ R) / half
    along = (rays @ R) / half
    round_t, round_n = _unit_sphere(origin, along)
    box_t, box_n = _unit_box(origin, along)
    is_box = solids.box[:, index, None]
    t = torch.where(is_box, box_t, round_t)
    normal = torch.where(is_box[..., None], box_n, round_n)
    normal = F.normalize((normal / half) @ R.mT, dim=-1)
    seen = (t > NEAREST) & (t < FURTHEST) & solids.there[:, index, None]
    return torch.where(seen, t, NOWHERE), normal


def _unit_sphere(
    origin: Tensor,  # [B, 1, 3] in half sizes
    along: Tensor,  # [B, N, 3] in half sizes
) -> tuple[Tensor, Tensor]:
    a, b = (along * along).sum(-1), (origin * along).sum(-1)
    discriminant = b * b - a * ((origin * origin).sum(-1) - 1.0)
    t = (-b - discriminant.clamp_min(0.0).sqrt()) / a
    t = torch.where(discriminant > 0.0, t, NOWHERE)
    return t, origin + t[..., None].clamp_max(FURTHEST) * along


def _unit_box(
    origin: Tensor,  # [B, 1, 3] in half sizes
    along: Tensor,  # [B, N, 3] in half sizes
) -> tuple[Tensor, Tensor]:
    inverse = 1.0 / torch.where(along.abs() < 1e-6, 1e-6, along)
    one, other = (-1.0 - origin) * inverse, (1.0 - origin) * inverse
    enter, axis = torch.minimum(one, other).max(-1)
    leave = torch.maximum(one, other).amin(-1)
    normal = -F.one_hot(axis, 3) * along.sign()
    return torch.where(enter < leave, enter, NOWHERE), normal
