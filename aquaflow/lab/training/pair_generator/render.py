"""A pair of a scene's pictures as they would be without water: radiance, depth, cameras."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.cameras import (
    PairMotion,
    first_camera,
    intrinsics,
    second_camera,
)
from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.march import FURTHEST, Hits, first_hits
from aquaflow.lab.training.pair_generator.noise import periodic
from aquaflow.lab.training.pair_generator.scene import Detail, SceneBatch, random_scenes
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
