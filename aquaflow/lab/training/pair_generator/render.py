"""A pair of a scene's pictures as they would be without water: radiance, depth, cameras."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.cameras import (
    PairMotion,
    first_camera,
    intrinsics,
    second_camera,
)
from aquaflow.lab.training.pair_generator.noise import Draw, periodic
from aquaflow.lab.training.pair_generator.scene import (
    Detail,
    SceneBatch,
    Solids,
    Terrain,
    random_scenes,
)
from aquaflow.lab.training.pairs import Pair, ViewBatch

BRIGHTEST = 1.5
"""Radiance that nothing exceeds; the pool stores radiances in 8 bits up to this."""
GRAZING = 0.1
"""Cosine below which a pixel's footprint grows no further."""
FALL_OFF, BRIGHTEST_LAMP = 1.5, 4.0
"""Of lamp light with range: less than the square, for lamps have an extent; and its limit, relative
to the light at the usual range."""


def render_pairs(
    draw: Draw, batch: int, width: int, height: int, motion: PairMotion, detail: Detail
) -> Pair:
    """``batch`` scenes, each seen twice; the images are radiances without water."""
    scene = random_scenes(draw, batch, detail)
    K = intrinsics(draw, batch, width, height)
    T_a = first_camera(draw, scene.terrain)
    a = render_view(draw, scene, K, T_a, width, height)
    T_b = second_camera(draw, scene.terrain, T_a, median_depth(a), motion)
    return Pair(a, render_view(draw, scene, K, T_b, width, height))


def median_depth(view: ViewBatch) -> Tensor:
    """[B] metres over the valid pixels; 2 where there is none."""
    known = torch.where(view.valid, view.depth, torch.nan).flatten(1)
    return known.nanmedian(1).values.nan_to_num(2.0)


def render_view(
    draw: Draw,
    scene: SceneBatch,
    K: Tensor,  # [B, 3, 3]
    T_wc: Tensor,  # [B, 4, 4]
    width: int,
    height: int,
) -> ViewBatch:
    """What a camera sees; caustics are where they happen to be."""
    batch = len(K)
    empty = torch.zeros(batch, height, width, device=K.device)
    blank = ViewBatch(empty[:, None].expand(-1, 3, -1, -1), empty, K, T_wc, empty > 0)
    rays = blank.rays(height, width).flatten(1, 2)
    in_world = rays @ T_wc[:, :3, :3].mT
    hits = first_hits(scene, T_wc[:, :3, 3], in_world)
    image = _radiance(draw, scene, hits, T_wc[:, :3, 3], in_world, rays, K)
    depth = torch.where(hits.found, hits.depth, 0.0).view_as(empty)
    return ViewBatch(image.view(batch, 3, height, width), depth, K, T_wc, depth > 0)


def _radiance(
    draw: Draw,
    scene: SceneBatch,
    hits: Hits,
    centre: Tensor,  # [B, 3]
    in_world: Tensor,  # [B, N, 3] rays of unit depth
    rays: Tensor,  # [B, N, 3] the same in the camera's frame
    K: Tensor,  # [B, 3, 3]
) -> Tensor:
    """[B, 3, N]"""
    points = centre[:, None] + hits.depth[..., None].clamp_max(FURTHEST) * in_world
    towards = -F.normalize(in_world, dim=-1)
    facing = (hits.normal * towards).sum(-1).clamp_min(0.0)
    period = scene.texture_period[:, None]
    places = (points[..., :2] + scene.shear[:, None] * points[..., 2:]) / period[..., None]
    range_m = hits.depth * rays.norm(dim=-1)
    footprint = range_m / (K[:, 0, 0, None] * period) / facing.clamp_min(GRAZING).sqrt()
    colour = scene.materials.albedo(places, footprint, hits.material)
    light = scene.light.lamps[:, None]
    shade = torch.lerp(
        _sunlight(draw, scene, hits, points),
        _lamplight(draw, scene, hits, rays, facing),
        light,
    )
    return (colour * shade[:, None]).clamp(0.0, BRIGHTEST) * hits.found[:, None]


def _sunlight(
    draw: Draw,
    scene: SceneBatch,
    hits: Hits,
    points: Tensor,  # [B, N, 3] world, m
) -> Tensor:
    """[B, N] sky plus sun, the sun gathered by the waves into a pattern that has moved on."""
    light = scene.light
    lambert = (hits.normal * light.sun[:, None]).sum(-1).clamp_min(0.0)
    along_sun = points[..., :2] - points[..., 2:] * light.sun[:, None, :2]
    moved = draw.uniform(len(points), 1, 2)
    pattern = periodic(light.pattern, along_sun / scene.texture_period[:, None, None] * 2 + moved)
    gathered = 1.0 + light.caustics[:, None] * (3.0 * pattern[:, 0] - 1.0)
    ambient = light.ambient[:, None]
    return ambient + (1.0 - ambient) * lambert * gathered


def _lamplight(
    draw: Draw,
    scene: SceneBatch,
    hits: Hits,
    rays: Tensor,  # [B, N, 3] camera, of unit depth
    facing: Tensor,  # [B, N] cosine
) -> Tensor:
    """[B, N] of lamps next to the camera: they fall off with range, and towards the beam's rim."""
    batch = len(rays)
    at = hits.depth[..., None].clamp_max(FURTHEST) * rays - scene.light.lamp[:, None]
    distance = at.norm(dim=-1).clamp_min(0.2)
    seen = torch.where(hits.found, distance, torch.nan)
    usual = seen.nanmedian(1, keepdim=True).values.nan_to_num(2.0)
    off_axis = (at[..., :2] / at[..., 2:].clamp_min(0.1)).square().sum(-1)
    beam = torch.exp(-off_axis * draw.uniform(batch, 1, high=2.5))
    light: Tensor = facing * beam * (usual / distance).pow(FALL_OFF).clamp_max(BRIGHTEST_LAMP)
    return light


# --------------------------------------------------------------------------------------------------
# Where rays meet a scene: the floor by marching and secant steps, bodies in closed form.

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
