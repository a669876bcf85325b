"""Man-made objects on the sea floor: pipes, crates, mooring blocks, floats, ropes.

Exact shapes (cylinder, box, sphere) met by rays in closed form. Coordinates here are the survey
frame with z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.lab.synthetic import tiles
from aquaflow.lab.synthetic.noise import FloatMap, fractal
from aquaflow.lab.synthetic.radiance import AMBIENT, SUN, SUN_DIRECTION
from aquaflow.lab.synthetic.relief import Area, Relief
from aquaflow.lab.synthetic.texture import MipAtlas

Array: TypeAlias = npt.NDArray[np.float64]
Rgb: TypeAlias = tuple[float, float, float]

TEXEL_M = 0.002
"""Edge of a texel of the objects' paint."""
TEXELS = 1024
"""Along an edge of the paint, which repeats: 2 m."""
GRAIN, GLAZE_GRAIN = 0.16, 0.04
"""Relative standard deviation of the albedo of paint, and of tiles."""


@dataclass(frozen=True)
class Solid:
    """One solid; its axes are the columns of ``R``."""

    kind: Literal["cylinder", "box", "sphere", "ellipsoid", "net"]
    centre: Array
    """[3] m"""
    R: Array
    """[3, 3]"""
    size: tuple[float, float, float]
    """Half sizes, m; a cylinder lies along its x and has radius size[1]; a sphere has size[0];
    a net lies in the plane of its x and y."""
    paint: Rgb
    growth: Rgb
    """Albedo of the bare object, and of the growth on it."""
    covered: float
    """How much is overgrown: 0.5 is half of it, 0 an eighth, -0.3 a thirtieth."""
    tile_m: float = 0.0
    """Edge of the tiles that cover it; 0: none."""
    mesh_m: float = 0.0
    """Edge of a net's meshes."""
    twine_m: float = 0.0
    """Thickness of a net's twine; what is between is open."""
    pattern_m: float | None = None
    """Where in the paint's texture it begins; None: where its place says, which must not move."""

    @property
    def reach(self) -> float:
        """Radius of the ball around it, m."""
        if self.kind == "sphere":
            return self.size[0]
        if self.kind == "cylinder":
            return math.hypot(self.size[0], self.size[1])
        return float(np.linalg.norm(self.size))


def _local(
    shape: Solid,
    origin: torch.Tensor,  # [3] m, or [3, N] of each ray
    rays: torch.Tensor,  # [3, N] unit vectors
) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins, of the shape that they had, and rays [3, N] in the shape's axes."""
    R = torch.tensor(shape.R.T, dtype=torch.float32)
    centre = torch.tensor(shape.centre, dtype=torch.float32)
    if origin.dim() == 1:
        return (R * (origin - centre)).sum(1), _turn(R, rays)
    return _turn(R, origin - centre[:, None]), _turn(R, rays)


def _turn(
    R: torch.Tensor,  # [3, 3]
    vectors: torch.Tensor,  # [3, N]
) -> torch.Tensor:
    """[3, N]; written out, as a matrix product may round differently with the number of threads."""
    x, y, z = vectors
    return torch.stack([R[k, 0] * x + R[k, 1] * y + R[k, 2] * z for k in range(3)])


def hit(
    shape: Solid,
    origin: torch.Tensor,  # [3] m, or [3, N] of each ray
    rays: torch.Tensor,  # [3, N] unit vectors
) -> torch.Tensor:
    """Range [N] (m) at which ``rays`` [3, N] enter the shape; infinite where they miss."""
    o, d = _local(shape, origin, rays)
    if shape.kind == "sphere":
        return _quadratic(torch.ones_like(d[0]), _dot(o, d), (o * o).sum(0) - shape.size[0] ** 2)
    if shape.kind == "ellipsoid":
        o, d = _as_ball(shape, o), _as_ball(shape, d)
        return _quadratic((d * d).sum(0), _dot(o, d), (o * o).sum(0) - 1.0)
    if shape.kind == "net":
        return _meet_twine(shape, o, d)
    if shape.kind == "box":
        near, far = _slabs(o, d, shape.size, (0, 1, 2))
        return torch.where((near < far) & (near > 0.0), near, torch.inf)
    a = (d[1] ** 2 + d[2] ** 2).clamp_min(1e-9)
    b = o[1] * d[1] + o[2] * d[2]
    disc = b * b - a * (o[1] ** 2 + o[2] ** 2 - shape.size[1] ** 2)
    root = disc.clamp_min(0.0).sqrt()
    near, far = _slabs(o, d, shape.size, (0,))
    enter, leave = torch.maximum(near, (-b - root) / a), torch.minimum(far, (-b + root) / a)
    return torch.where((disc > 0.0) & (enter < leave) & (enter > 0.0), enter, torch.inf)


def _as_ball(
    shape: Solid,
    vectors: torch.Tensor,  # [3] or [3, N] m, in the shape's axes
) -> torch.Tensor:
    """The same where the ellipsoid is a ball of radius 1."""
    size = torch.tensor(shape.size, dtype=torch.float32)
    return vectors / (size if vectors.dim() == 1 else size[:, None])


def _meet_twine(
    shape: Solid,
    o: torch.Tensor,  # [3] or [3, N] m, in the shape's axes
    d: torch.Tensor,  # [3, N]
) -> torch.Tensor:
    """Range [N] (m) at which rays meet a net's twine; infinite where they go through a mesh."""
    t = -o[2] / torch.where(d[2].abs() < 1e-7, 1e-7, d[2])
    on_twine = torch.zeros_like(t, dtype=torch.bool)
    inside = torch.ones_like(on_twine)
    for k in (0, 1):
        at = o[k] + t * d[k]
        from_twine = (torch.remainder(at / shape.mesh_m + 0.5, 1.0) - 0.5).abs() * shape.mesh_m
        on_twine |= from_twine < 0.5 * shape.twine_m
        inside &= at.abs() < shape.size[k]
    return torch.where((t > 0.0) & on_twine & inside, t, torch.inf)


def _dot(
    o: torch.Tensor,  # [3, ...]
    d: torch.Tensor,  # [3, ...]
) -> torch.Tensor:
    return o[0] * d[0] + o[1] * d[1] + o[2] * d[2]


def _quadratic(
    a: torch.Tensor,  # [N]
    b: torch.Tensor,  # [N]
    c: torch.Tensor,  # [] or [N]
) -> torch.Tensor:
    disc = b * b - a * c
    t = (-b - disc.clamp_min(0.0).sqrt()) / a
    return torch.where((disc > 0.0) & (t > 0.0), t, torch.inf)


def _slabs(
    o: torch.Tensor,  # [3] or [3, N], in the shape's axes
    d: torch.Tensor,  # [3, N]
    size: tuple[float, float, float],
    axes: tuple[int, ...],
) -> tuple[torch.Tensor, torch.Tensor]:
    """Ranges [N] of entering the last and leaving the first pair of planes."""
    near = torch.full_like(d[0], -torch.inf)
    far = torch.full_like(d[0], torch.inf)
    for k in axes:
        inverse = 1.0 / torch.where(d[k].abs() < 1e-7, 1e-7, d[k])
        one, two = (-size[k] - o[k]) * inverse, (size[k] - o[k]) * inverse
        near = torch.maximum(near, torch.minimum(one, two))
        far = torch.minimum(far, torch.maximum(one, two))
    return near, far


def radiance(
    shape: Solid,
    texture: MipAtlas,
    origin: torch.Tensor,  # [3] m, or [3, N] of each ray
    rays: torch.Tensor,  # [3, N]
    t: torch.Tensor,  # [N] m, where they hit
    pixel: float,
) -> torch.Tensor:
    """Clean radiance [3, N] where ``rays`` meet ``shape``."""
    o, d = _local(shape, origin, rays)
    p = o.reshape(3, -1) + t * d
    normal, u, v = _surface(shape, p)
    facing = -(normal * d).sum(0).clamp(-1.0, -0.05)
    footprint = t * pixel * facing.rsqrt() / TEXEL_M
    place = 311.0 * float(shape.centre[0])
    shift = (place if shape.pattern_m is None else shape.pattern_m / TEXEL_M) % TEXELS
    noise = texture.mirror(u / TEXEL_M + shift, v / TEXEL_M + 2.0 * shift, footprint)
    grown = torch.sigmoid(5.0 * (noise[1] + 2.4 * (shape.covered - 0.5)))
    grain = GRAIN if shape.tile_m == 0.0 else GLAZE_GRAIN
    paint = torch.tensor(shape.paint)[:, None] * (1.0 + grain * noise[0])
    if shape.tile_m > 0.0:
        paint = tiles.lay(paint, texture, u, v, t * pixel * facing.rsqrt(), shape.tile_m)
    growth = torch.tensor(shape.growth)[:, None] * (1.0 + 0.28 * noise[0])
    R = torch.tensor(shape.R, dtype=torch.float32)
    up = R[2, 0] * normal[0] + R[2, 1] * normal[1] + R[2, 2] * normal[2]
    sun = torch.tensor(SUN_DIRECTION @ shape.R, dtype=torch.float32)
    direct = _dot(sun, normal).clamp_min(0.0)
    light = AMBIENT * (0.62 + 0.38 * up) + SUN * direct
    return ((paint + grown * (growth - paint)) * light).clamp(0.004, 0.98)


def normals(
    shape: Solid,
    origin: torch.Tensor,  # [3] m, or [3, N] of each ray
    rays: torch.Tensor,  # [3, N]
    t: torch.Tensor,  # [N] m, where they hit
) -> torch.Tensor:
    """[3, N] unit, outward, where ``rays`` meet ``shape``."""
    o, d = _local(shape, origin, rays)
    normal, _, _ = _surface(shape, o.reshape(3, -1) + t * d)
    return _turn(torch.tensor(shape.R, dtype=torch.float32), normal)


def _surface(
    shape: Solid,
    p: torch.Tensor,  # [3, N] m
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Outward normal [3, N] and texture position u, v [N] (m) of local points [3, N]."""
    half = torch.tensor(shape.size)[:, None]
    if shape.kind == "cylinder":
        angle = torch.atan2(p[2], p[1])
        side = torch.stack([torch.zeros_like(angle), angle.cos(), angle.sin()])
        cap = torch.stack([p[0].sign(), torch.zeros_like(angle), torch.zeros_like(angle)])
        is_cap = (p[0].abs() > shape.size[0] - 1e-4) & (p[1].hypot(p[2]) < shape.size[1] - 1e-4)
        u = torch.where(is_cap, p[1], p[0])
        return torch.where(is_cap, cap, side), u, torch.where(is_cap, p[2], angle * shape.size[1])
    axis = (p / half).abs().argmax(0)
    face = torch.nn.functional.one_hot(axis, 3).T * p.sign()
    if shape.kind == "net":
        up = torch.zeros_like(p)
        up[2] = 1.0
        return up, p[0], p[1]
    if shape.kind == "ellipsoid":
        steep = p / half**2
        return steep / steep.norm(dim=0), p[0], p[2]
    normal = p / shape.size[0] if shape.kind == "sphere" else face
    # Each pair of faces reads its own part of the texture.
    apart = 0.7 * axis + 0.23 * (face.sum(0) > 0)
    u = torch.where(axis == 0, p[1], p[0]) + apart
    v = torch.where(axis == 2, p[1], p[2]) + apart
    return normal, u, v


def object_texture(rng: np.random.Generator) -> MipAtlas:
    """Two channels of unit-variance noise: fine grain, and patches of growth."""
    shape = (TEXELS, TEXELS)
    grain = fractal(rng, shape, TEXEL_M, 0.25, 0.0, 0.85)
    patches = fractal(rng, shape, TEXEL_M, 0.35, 0.0, 0.55)
    return MipAtlas(np.stack([grain, patches], axis=-1), levels=6)


def casters(relief: Relief, shapes: list[Solid]) -> FloatMap:
    """The relief with the tops of the shapes [H, W] (m): what throws shade on the ground."""
    area: Area = relief.area
    height = relief.height.copy()
    down = torch.tensor([0.0, 0.0, -1.0])
    for shape in shapes:
        low = (shape.centre[:2] - shape.reach - (area.x0, area.y0)) / area.cell
        high = (shape.centre[:2] + shape.reach - (area.x0, area.y0)) / area.cell
        columns = np.arange(max(0, int(low[0])), min(area.shape[1], int(high[0]) + 1))
        rows = np.arange(max(0, int(low[1])), min(area.shape[0], int(high[1]) + 1))
        if len(rows) == 0 or len(columns) == 0:
            continue
        x, y = np.meshgrid(
            area.x0 + (columns + 0.5) * area.cell, area.y0 + (rows + 0.5) * area.cell
        )
        top = _tops(shape, x, y, down)
        window = height[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        np.maximum(window, top, out=window)
    return height


def _tops(
    shape: Solid,
    x: Array,  # [H, W] m
    y: Array,  # [H, W] m
    down: torch.Tensor,  # [3] unit vector
) -> FloatMap:
    """Height [H, W] of the shape's upper side; -inf outside it."""
    # All rays are parallel: a ray's own start is a shift of the shape.
    R = torch.tensor(shape.R.T, dtype=torch.float32)
    offset = torch.tensor(np.stack([x, y], 0).reshape(2, -1), dtype=torch.float32)
    start = torch.cat([offset, torch.full((1, offset.shape[1]), 50.0)])
    start = start - torch.tensor(shape.centre, dtype=torch.float32)[:, None]
    o = torch.stack([(R[k][:, None] * start).sum(0) for k in range(3)])
    d = (R * down).sum(1)[:, None].expand_as(o)
    near, far = _slabs(o, d, _bounds(shape), (0, 1, 2))
    top = torch.where(near < far, 50.0 - near, -torch.inf)
    return np.asarray(top.numpy().reshape(x.shape), np.float32)


def _bounds(shape: Solid) -> tuple[float, float, float]:
    """Half sizes of a box that throws about the same shade."""
    if shape.kind == "sphere":
        return (0.8 * shape.size[0],) * 3
    if shape.kind == "cylinder":
        return shape.size[0], 0.9 * shape.size[1], 0.9 * shape.size[1]
    return shape.size
